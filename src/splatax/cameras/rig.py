"""Geometry of the cameras of a capture: what they look at, which way is up, how large the scene is.

Each is defined here once, for training, camera trajectories, web pages and exports.
"""

from collections.abc import Hashable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from splatax.cameras.camera import Camera

EXTENT_MARGIN = 1.1  # of the cameras' radius (authors' code of Kerbl et al. 2023)
LEVEL_WEIGHT = 0.02  # weight of "tops point up" relative to "horizontal axes are level"
LEAST_TURN = 1e-6  # least mean squared sine between optical axes for which they define a common point


def positions_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "n 3"]:
    """Returns the optical centres, world units."""
    return np.stack([np.asarray(camera.position, np.float64) for camera in cameras])


def numbers_of_lenses(cameras: Sequence[Camera]) -> list[int]:
    """Returns the number of each camera's lens, from 0. Two have the same if all but their poses is equal."""
    known: dict[Hashable, int] = {}
    numbers = []
    for camera in cameras:
        leaves, kind = jax.tree.flatten((camera.focal, camera.center, camera.lens))
        key = (kind, camera.width, camera.height, *(np.asarray(leaf).tobytes() for leaf in leaves))
        numbers.append(known.setdefault(key, len(known)))
    return numbers


def axes_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "n 3"]:
    """Returns the optical axes: unit vectors in the world along which the cameras look."""
    return np.stack([np.asarray(camera.rotation, np.float64)[2] for camera in cameras])


def tops_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "n 3"]:
    """Returns the unit vectors in the world that point to the top of each image."""
    return -np.stack([np.asarray(camera.rotation, np.float64)[1] for camera in cameras])


def up_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Returns the unit vector that points up, assuming that the photos were held level.

    It is the direction most nearly at right angles to the horizontal (x) axes of all cameras, on the
    side of their tops. A small weight on the mean of the tops decides if all cameras look the same way.
    """
    right = np.stack([np.asarray(camera.rotation, np.float64)[0] for camera in cameras])
    top = tops_of(cameras).mean(axis=0)
    level = right.T @ right / len(right)
    up = np.linalg.eigh(LEVEL_WEIGHT * np.outer(top, top) - level)[1][:, -1]
    return up if up @ top >= 0 else -up


def focus_of(cameras: Sequence[Camera], least_turn: float = LEAST_TURN) -> Float[np.ndarray, "3"] | None:
    """Returns the point that the cameras look at, or None if there is none.

    It is the point nearest to all optical axes in the sense of least squares. There is none if the axes are
    nearly parallel, or the point is behind most cameras.

    Args:
        cameras: one or more.
        least_turn: the least mean squared sine of the angles between the axes and any one direction.
    """
    axes = axes_of(cameras)
    if np.linalg.eigvalsh(_across(axes).mean(axis=0))[0] <= least_turn:
        return None
    point = nearest_to_axes(cameras)
    return point if np.median(np.sum((point - positions_of(cameras)) * axes, axis=1)) > 0 else None


def nearest_to_axes(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Returns the point nearest to all optical axes in the sense of least squares, however parallel they are.

    It solves sum (I - a a^T) (p - position) = 0 over the axes a. Where the axes leave a direction undecided,
    it is the solution nearest to the origin.
    """
    across = _across(axes_of(cameras))
    moments = np.einsum("nij,nj->i", across, positions_of(cameras))
    return np.linalg.lstsq(across.sum(axis=0), moments, rcond=None)[0]


def extent_of(cameras: Sequence[Camera], points: Float[np.ndarray, "m 3"]) -> float:
    """Returns the size of a scene, world units: 1.1 times the largest distance of a camera from their mean.

    If all cameras are in one place, it is the median distance of the points from there, or 1 without points.
    """
    positions = positions_of(cameras)
    centre = positions.mean(axis=0)
    radius = float(np.linalg.norm(positions - centre, axis=1).max())
    if radius > 1e-6 * float(np.abs(positions).max(initial=0)):
        return EXTENT_MARGIN * radius
    if len(points):
        return float(np.median(np.linalg.norm(points - centre, axis=1))) or 1.0
    return 1.0


def _across(axes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Returns I - a a^T, the projection onto the plane across each axis."""
    return np.eye(3) - axes[:, :, None] * axes[:, None, :]
