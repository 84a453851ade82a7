"""Size of the voxels of a mesh, from the views: neither finer than the pixels nor than the depth's noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from splatax.cameras import rig
from splatax.cameras.geometry import points_at, seen_at
from splatax.errors import InputError
from splatax.mesh.views import DepthView, sampled

VIEWS = 16  # that are looked at, evenly spaced
PIXELS = 1000  # of each of them
HIDDEN = 0.1  # of the depth: views that differ by more see different surfaces


@dataclass(frozen=True)
class Resolution:
    """Fineness of the depth of a set of views.

    Attributes:
        pixel: median width of a pixel on the surface that it sees, world units.
        noise: median difference between the depth of a surface in one view and in the nearest other view,
            world units; 0 if no two views see a surface in common.
    """

    pixel: float
    noise: float

    @property
    def voxel(self) -> float:
        """Width of the voxels that suit the views: that of a pixel, or the noise if it is larger."""
        return max(self.pixel, self.noise)


def resolution_of(views: Sequence[DepthView]) -> Resolution:
    """Measures the width of pixels and the noise of depth, on a sample of the views.

    Raises:
        InputError: if no view sees a surface.
    """
    chosen = range(0, len(views), -(-len(views) // VIEWS) or 1)
    positions = rig.positions_of([view.camera for view in views]) if views else np.zeros((0, 3))
    axes = rig.axes_of([view.camera for view in views]) if views else positions
    rng = np.random.default_rng(0)
    widths: list[np.ndarray] = []
    differences: list[np.ndarray] = []
    for i in chosen:
        view, depth = views[i], views[i].read().depth
        rows, columns = np.nonzero(depth > 0)
        if not len(rows):
            continue
        few = rng.choice(len(rows), min(PIXELS, len(rows)), replace=False)
        pixels, depths = np.stack([columns, rows], axis=1)[few] + 0.5, depth[rows[few], columns[few]]
        points = points_at(view.camera, pixels, depths)
        beside = points_at(view.camera, pixels + [1, 0], depths)
        widths.append(np.linalg.norm(beside - points, axis=1))
        apart = np.linalg.norm(positions - positions[i], axis=1) + (1 - axes @ axes[i])
        apart[i] = np.inf
        if len(views) > 1:
            differences.append(_differences(views[int(np.argmin(apart))], points))
    if not widths:
        raise InputError(
            "No camera sees a surface: the scene is less than half opaque everywhere. Train it longer."
        )
    every = np.concatenate([*differences, np.zeros(0)])
    noise = float(np.median(np.abs(every))) if len(every) else 0.0
    return Resolution(float(np.median(np.concatenate(widths))), noise)


def _differences(view: DepthView, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " k"]:
    """Returns the differences between the depth of a view and that of points, for those that it sees."""
    pixels, depths = seen_at(view.camera, points)
    found = np.asarray(sampled(view.read().depth, np.nan_to_num(pixels, nan=-1.0).astype(np.float32)))
    difference = found - depths
    return difference[(found > 0) & (np.abs(difference) < HIDDEN * found)]
