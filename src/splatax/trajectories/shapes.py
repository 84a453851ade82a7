"""Orbit and spiral, from where the cameras of a capture are and what they look at."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.camera import Camera, look_at
from splatax.errors import InputError
from splatax.trajectories.interpolation import Key, Size

FOCAL = 0.8  # of the longer side of the image, for a scene without cameras
VIEW = (0.5, 0.2, 1.0)  # direction in which it is looked at: from above where y points down
LEVEL_WEIGHT = 0.02  # of "tops point up", against "sides are level"
TURNS = 2  # of the spiral
REACH = 90  # percentile of the cameras' offsets that the spiral goes out to
# (both from the authors' code of Mildenhall et al. 2019, Local Light Field Fusion)


def orbit(cameras: Sequence[Camera], frames: int, size: Size, focus: Float[np.ndarray, "3"]) -> list[Camera]:
    """One turn around a point, at the height and distance that the cameras have in the median.

    It starts beside the first camera that is not nearer than most, and looks at the point all the time.

    Args:
        cameras: of the capture, one or more.
        frames: how many.
        size: of the pictures.
        focus: the point; see `focus_of`.

    Raises:
        InputError: if the cameras are right above the point.
    """
    positions, up = _positions(cameras), up_of(cameras)
    heights = (positions - focus) @ up
    level = positions - focus - heights[:, None] * up
    distances = np.linalg.norm(level, axis=1)
    distance = float(np.median(distances))
    sideways = level[int(np.argmax(distances >= distance))]
    if distance <= 1e-6 * float(np.linalg.norm(positions - focus, axis=1).max()):
        raise InputError("--path orbit: the cameras are right above what they look at. Ask for interpolate.")
    sideways = sideways / np.linalg.norm(sideways) * distance
    fov = _fov(cameras, size)
    path = []
    for angle in np.linspace(0, 2 * np.pi, frames, endpoint=False):
        offset = Rotation.from_rotvec(angle * up).apply(sideways)
        path.append(_looking(focus + offset + np.median(heights) * up, focus, up, fov).camera(size))
    return path


def spiral(
    cameras: Sequence[Camera], frames: int, size: Size, points: Float[np.ndarray, "n 3"]
) -> list[Camera]:
    """Two turns before a capture that was taken in one direction, as in the films of Mildenhall et al. 2019.

    All look at one point, at the depth that the mean of the inverse depths of `points` tells.

    Args:
        cameras: of the capture, one or more.
        frames: how many.
        size: of the pictures.
        points: on surfaces of the scene.

    Raises:
        InputError: if the cameras look in all directions, or have none of the points before them.
    """
    positions = _positions(cameras)
    forward = np.mean([np.asarray(camera.rotation, np.float64)[2] for camera in cameras], axis=0)
    if np.linalg.norm(forward) < 0.5:
        raise InputError("--path spiral: the cameras look in all directions. Ask for orbit, or interpolate.")
    centre = positions.mean(axis=0)
    fov = _fov(cameras, size)
    middle = _looking(centre, centre + forward, up_of(cameras), fov)
    axes = middle.rotation.as_matrix().T
    reach = np.percentile(np.abs((positions - centre) @ axes.T), REACH, axis=0)
    depths = (points - centre) @ axes[2]
    visible = depths > 1e-3 * max(np.abs(depths).max(initial=0), 1e-12)
    if not visible.any():
        raise InputError("--path spiral: nothing of the scene is before the cameras. Ask for interpolate.")
    target = centre + axes[2] / np.mean(1 / depths[visible])
    path = []
    for angle in np.linspace(0, 2 * np.pi * TURNS, frames, endpoint=False):
        offset = np.array([np.cos(angle), np.sin(angle), np.sin(angle / TURNS)]) * reach
        path.append(_looking(centre + offset @ axes, target, -axes[1], fov).camera(size))
    return path


def overview(points: Float[np.ndarray, "n 3"], size: Size, nearness: float = 1.0) -> Camera:
    """A camera that has nearly all of a scene in view, y pointing down.

    Args:
        points: of the scene, one or more.
        size: of the picture.
        nearness: 3 is a third as far from the middle.
    """
    low, high = np.percentile(np.asarray(points, np.float64), [1, 99], axis=0)
    centre, radius = (low + high) / 2, max(np.linalg.norm(high - low) / 2, 1e-6)
    focal = FOCAL * max(size)
    distance = radius / np.sin(np.arctan(min(size) / 2 / focal)) / nearness
    position = centre - distance * np.array(VIEW) / np.linalg.norm(VIEW)
    pose = look_at(*(jnp.asarray(v, jnp.float32) for v in (position, centre, (0, -1, 0))))
    return Camera.simple_pinhole(focal, pose, *size)


def focus_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point nearest to all optical axes, in the sense of least squares.

    Raises:
        InputError: if most cameras have it behind them, or the axes are parallel.
    """
    positions = _positions(cameras)
    forward = np.stack([np.asarray(camera.rotation, np.float64)[2] for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < 1e-6 * len(cameras):
        raise InputError("--path orbit: all cameras look the same way. Ask for spiral, or interpolate.")
    point = np.linalg.solve(normal, np.einsum("nij,nj->i", across, positions))
    if np.median(np.einsum("ni,ni->n", point - positions, forward)) <= 0:
        raise InputError("--path orbit: the cameras look outwards, at no common point. Ask for interpolate.")
    return point


def up_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """What is up, of length one: photos are held level, so it is at right angles to the cameras' right
    sides; and on the side of their tops, which also decides where all look the same way."""
    rotations = np.stack([np.asarray(camera.rotation, np.float64) for camera in cameras])
    right, top = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    level = right.T @ right / len(right)
    up = np.linalg.eigh(LEVEL_WEIGHT * np.outer(top, top) - level)[1][:, -1]
    return up if up @ top >= 0 else -up


def _positions(cameras: Sequence[Camera]) -> Float[np.ndarray, "n 3"]:
    return np.stack([np.asarray(camera.position, np.float64) for camera in cameras])


def _fov(cameras: Sequence[Camera], size: Size) -> float:
    return float(np.median([Key.of(camera, size).fov for camera in cameras]))


def _looking(position: np.ndarray, target: np.ndarray, up: np.ndarray, fov: float) -> Key:
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    return Key(
        position, Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1)), fov
    )
