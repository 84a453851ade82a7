"""Cameras and points of a capture in one picture, from above and from the side."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera, rig
from splatax.dataset import Dataset
from splatax.report.next_photos import Spot
from splatax.report.pictures import encoded

MOST_POINTS = 20_000
MARGIN = 0.08  # of the picture's width
SHOWN = (2, 98)  # percentiles of the points that the picture has room for, beside all cameras
ARROW = 0.12  # of the picture's width: the length of viewing directions
DPI = 110
MATCHED, BAD, UNSCORED, NEXT = "#2a7a3b", "#c62828", "#9e9e9e", "#1565c0"  # colours of the map


def plan(dataset: Dataset) -> str:
    """Plots cameras and points from above and from the side, as a PNG in a data URI.

    Up is that of `cameras.rig.up_of`: photos are assumed to be held level.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure  # slow to import

    cameras = [view.camera for view in dataset.standpoints]
    positions, axes = rig.positions_of(cameras), rig.axes_of(cameras)
    chosen = np.random.default_rng(0).permutation(len(dataset.points))[:MOST_POINTS]
    cloud, colors = dataset.points.positions[chosen], dataset.points.colors[chosen]
    tested = np.array([view in dataset.test for view in dataset.standpoints])
    figure = Figure(figsize=(11, 5.2), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    for panel, (title, across, upward) in zip(
        figure.subplots(1, 2), (("from above", 0, 1), ("from the side", 1, 2)), strict=True
    ):
        pick = upright_frame(cameras)[[across, upward]]
        flat_cloud, flat = cloud @ pick.T, positions @ pick.T
        centre, half = window(flat_cloud, flat)
        panel.scatter(*flat_cloud.T, c=np.clip(colors, 0, 1), s=1.5, linewidths=0)
        looking = axes @ pick.T * half * ARROW
        for kind, color, label in ((~tested, "C0", "training"), (tested, "C3", "held out")):
            if kind.any():
                panel.quiver(*flat[kind].T, *looking[kind].T, color=color, width=0.003, **QUIVER)
                panel.scatter(*flat[kind].T, color=color, s=14, label=label)
        panel.set_xlim(centre[0] - half, centre[0] + half)
        panel.set_ylim(centre[1] - half, centre[1] + half)
        panel.set_aspect("equal")
        panel.set_title(title)
        panel.legend(loc="upper right", fontsize="small")
    return png(figure)


def places(dataset: Dataset, good: Mapping[str, bool], spots: Sequence[Spot]) -> str:
    """Plots from above where the cameras stand, how well they are matched, and where to take the next photos.

    Args:
        dataset: the capture.
        good: whether the scene matches a photo well, by name, for those that have a score.
        spots: places for the next photos.

    Returns:
        A PNG in a data URI.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure  # slow to import

    cameras = [view.camera for view in dataset.standpoints]
    positions, axes = rig.positions_of(cameras), rig.axes_of(cameras)
    chosen = np.random.default_rng(0).permutation(len(dataset.points))[:MOST_POINTS]
    cloud, colors = dataset.points.positions[chosen], dataset.points.colors[chosen]
    ground = upright_frame(cameras)[:2]
    next_ones = np.array([spot.position for spot in spots]).reshape(-1, 3) @ ground.T
    flat = positions @ ground.T
    centre, half = window(cloud @ ground.T, np.concatenate([flat, next_ones]))
    figure = Figure(figsize=(5.6, 6), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    panel.scatter(
        cloud @ ground[0], cloud @ ground[1], c=np.clip(colors, 0, 1), s=1.5, linewidths=0, alpha=0.4
    )
    looking = axes @ ground.T * half * ARROW
    states = [good.get(view.photo) for view in dataset.standpoints]
    for state, color, label in (
        (None, UNSCORED, "photo"),
        (True, MATCHED, "like the others"),
        (False, BAD, "matched badly"),
    ):
        rows = np.array([each is state for each in states])
        if rows.any():
            panel.quiver(*flat[rows].T, *looking[rows].T, color=color, width=0.004, **QUIVER)
            panel.scatter(flat[rows, 0], flat[rows, 1], color=color, s=22, label=label)
    if len(next_ones):
        panel.scatter(next_ones[:, 0], next_ones[:, 1], color=NEXT, s=170, marker="*", label="next photos")
        for number, place in enumerate(next_ones, start=1):
            panel.annotate(str(number), place, (6, 6), textcoords="offset points", color=NEXT, fontsize=13)
    panel.set_xlim(centre[0] - half, centre[0] + half)
    panel.set_ylim(centre[1] - half, centre[1] + half)
    panel.set_aspect("equal")
    panel.set_xticks([])
    panel.set_yticks([])
    figure.legend(loc="outside lower center", ncols=2)
    return png(figure)


def png(figure: Any) -> str:
    """Returns a matplotlib figure as a PNG in a data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return encoded(buffer.getvalue(), "image/png")


QUIVER: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}


def upright_frame(cameras: Sequence[Camera]) -> Float[np.ndarray, "3 3"]:
    """Returns unit vectors to the right, away from the viewer and up, as rows: the first two span the ground.

    "Away" is the mean direction of view along the ground.
    """
    up = rig.up_of(cameras)
    ahead = rig.axes_of(cameras).mean(axis=0)
    spare = np.eye(3)[np.argmin(np.abs(up))]
    away = unit(ahead - up * (ahead @ up), unit(spare - up * (spare @ up), spare))
    return np.stack([np.cross(away, up), away, up])


def unit(vector: Float[np.ndarray, "3"], otherwise: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Returns a vector scaled to length 1; `otherwise` if it is nearly zero."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise


def window(
    cloud: Float[np.ndarray, "n 2"], cameras: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Returns centre and half the side of a square around all cameras and most points."""
    corners = np.percentile(cloud, SHOWN, axis=0) if len(cloud) else cameras
    corners = np.concatenate([corners, cameras])
    low, high = corners.min(axis=0), corners.max(axis=0)
    return (low + high) / 2, float((high - low).max() / 2 * (1 + 2 * MARGIN)) or 1.0
