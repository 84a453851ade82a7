"""Places for the next photos: gaps between the cameras, and places whose photos are matched badly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from splatax.cameras import rig
from splatax.dataset import Dataset, by_photo

LARGE, LARGEST = 2.5, 120.0  # a gap: times the median step around the subject; degrees, beyond it is a choice
LEAST = 20.0  # degrees that a gap has at least
FLAT = 8.0  # degrees of elevation that cameras around a subject span, below which they are at one height
MOST = 6  # spots
ISOLATED = 1.4  # times the usual distance to the nearest training photo, from which a photo stands alone
BLOCK = 256  # photos whose distances to all others are held at a time
TURN = 1.0  # weight of the angle between directions, radians, beside distance as a fraction of the extent


@dataclass(frozen=True)
class Spot:
    """A place for the next photos.

    Attributes:
        position: world units.
        why: the reason for new photos there.
        fix: advice for the photos to take.
        gap: true if it lies in a gap between the cameras, false if a photo there is bad.
    """

    position: Float[np.ndarray, "3"]
    why: str
    fix: str
    gap: bool


def spots_of(dataset: Dataset, bad: Sequence[str]) -> list[Spot]:
    """Returns at most six places for the next photos, gaps between the cameras first.

    Args:
        dataset: the capture.
        bad: names of photos that the scene matches badly.
    """
    cameras = {view.photo: view.camera for view in dataset.standpoints}
    spots = _gaps(dataset) if len(cameras) > 4 else []
    apart = spacings(dataset) if bad else {}
    for name in bad:
        if name in cameras and apart.get(name, 1.0) > ISOLATED:
            position = rig.positions_of([cameras[name]])[0]
            why = f"{name} is matched badly, and the other photos are far from it."
            spots.append(Spot(position, why, "Take two or three photos on each side of it.", False))
    return spots[:MOST]


def spacings(dataset: Dataset) -> dict[str, float]:
    """Returns how far each photo's nearest training photo is, in multiples of the usual distance, by name.

    The distance of two photos counts the way between them, as a fraction of the extent, and the angle
    between their directions. The result is empty if there are fewer than three training photos, or the usual
    distance is zero.
    """
    if len(dataset.train) < 3:
        return {}
    views, tested = dataset.views, {view.name for view in dataset.test}
    cameras = [view.camera for view in views]
    trained = np.array([view.name not in tested for view in views])
    positions, axes = rig.positions_of(cameras), rig.axes_of(cameras)
    nearest = np.zeros(len(views))
    for start in range(0, len(views), BLOCK):
        rows = slice(start, start + BLOCK)
        way = np.linalg.norm(positions[rows, None] - positions[trained], axis=2) / dataset.extent
        apart = way + TURN * np.arccos(np.clip(axes[rows] @ axes[trained].T, -1, 1))
        own = np.flatnonzero(trained)[None] == np.arange(start, start + len(apart))[:, None]
        nearest[rows] = np.where(own, np.inf, apart).min(axis=1)
    usual = float(np.median(nearest[trained]))
    if usual <= 0:
        return {}
    apart_of = by_photo(views, {view.name: float(nearest[i] / usual) for i, view in enumerate(views)})
    return {photo: min(each) for photo, each in apart_of.items()}


def _gaps(dataset: Dataset) -> list[Spot]:
    """Returns the middles of gaps around the point that the cameras look at, the widest first."""
    cameras = [view.camera for view in dataset.standpoints]
    focus = rig.focus_of(cameras)
    if focus is None:
        return []
    up = rig.up_of(cameras)
    offsets = rig.positions_of(cameras) - focus
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    radius = np.linalg.norm(level, axis=1)
    if radius.min() < 1e-6:
        return []
    first = level[0] / radius[0]
    second = np.cross(up, first)
    azimuths = np.degrees(np.arctan2(level @ second, level @ first)) % 360
    order = np.argsort(azimuths)
    widths = np.diff(azimuths[order], append=azimuths[order[0]] + 360)
    limit = max(LARGE * float(np.median(widths)), LEAST)
    spots = []
    for i in np.argsort(-widths, kind="stable"):
        if not limit < widths[i] < LARGEST:
            continue
        middle = np.radians(azimuths[order[i]] + widths[i] / 2)
        around = np.median(radius) * (np.cos(middle) * first + np.sin(middle) * second)
        why = f"No photo was taken over {widths[i]:.0f} degrees of the way around the subject."
        spots.append(Spot(focus + around + np.median(heights) * up, why, "Fill the gap with photos.", True))
    elevations = np.degrees(np.arctan2(heights, radius))
    if np.ptp(elevations) < FLAT and 360 - widths.max() > 90:
        higher = level[0] + (heights[0] + np.tan(np.radians(25)) * radius[0]) * up
        why = f"All photos were taken from one height (within {np.ptp(elevations):.0f} degrees)."
        spots.append(Spot(focus + higher, why, "Go around once more, higher or lower.", True))
    return spots
