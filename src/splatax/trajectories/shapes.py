"""Orbit and spiral trajectories, derived from the cameras of a capture."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera, look_at, rig
from splatax.errors import InputError
from splatax.trajectories.interpolation import Keyframe, Size

FOCAL = 0.8  # focal length for a scene without cameras, in units of the longer side of the image
VIEW = (0.5, 0.2, 1.0)  # viewing direction for a scene without cameras: from above if y points down
TURNS = 2  # turns of the spiral
REACH = 90  # percentile of the cameras' offsets that is the amplitude of the spiral
# (both from the authors' code of Mildenhall et al. 2019, Local Light Field Fusion)


def orbit(cameras: Sequence[Camera], frames: int, size: Size, focus: Float[np.ndarray, "3"]) -> list[Camera]:
    """Returns one turn around a point, at the cameras' median height above it and median distance from it.

    The orbit starts near the first camera whose distance is at least the median. Every frame looks at
    the point.

    Args:
        cameras: cameras of the capture, one or more.
        frames: number of cameras to return.
        size: width and height of the frames, pixels.
        focus: the point, such as `focus_of(cameras)`, world units.

    Raises:
        InputError: if the cameras are directly above the point.
    """
    positions, up = rig.positions_of(cameras), rig.up_of(cameras)
    heights = (positions - focus) @ up
    level = positions - focus - heights[:, None] * up
    distances = np.linalg.norm(level, axis=1)
    distance = float(np.median(distances))
    sideways = level[int(np.argmax(distances >= distance))]
    if distance <= 1e-6 * float(np.linalg.norm(positions - focus, axis=1).max()):
        raise InputError("orbit: the cameras are directly above what they look at. Use interpolate.")
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
    """Returns a spiral of two turns for a forward-facing capture, as in the videos of Mildenhall et al. 2019.

    Every frame looks at one point, whose inverse depth is the mean of the inverse depths of `points`.

    Args:
        cameras: cameras of the capture, one or more.
        frames: number of cameras to return.
        size: width and height of the frames, pixels.
        points: points on surfaces of the scene, world units.

    Raises:
        InputError: if the cameras look in all directions, or none of the points is in front of them.
    """
    positions = rig.positions_of(cameras)
    forward = rig.axes_of(cameras).mean(axis=0)
    if np.linalg.norm(forward) < 0.5:
        raise InputError("spiral: the cameras look in all directions. Use orbit or interpolate.")
    centre = positions.mean(axis=0)
    fov = _fov(cameras, size)
    middle = _looking(centre, centre + forward, rig.up_of(cameras), fov)
    axes = middle.rotation.as_matrix().T
    reach = np.percentile(np.abs((positions - centre) @ axes.T), REACH, axis=0)
    depths = (points - centre) @ axes[2]
    visible = depths > 1e-3 * max(np.abs(depths).max(initial=0), 1e-12)
    if not visible.any():
        raise InputError("spiral: nothing of the scene is in front of the cameras. Use interpolate.")
    target = centre + axes[2] / np.mean(1 / depths[visible])
    path = []
    for angle in np.linspace(0, 2 * np.pi * TURNS, frames, endpoint=False):
        offset = np.array([np.cos(angle), np.sin(angle), np.sin(angle / TURNS)]) * reach
        path.append(_looking(centre + offset @ axes, target, -axes[1], fov).camera(size))
    return path


def overview(points: Float[np.ndarray, "n 3"], size: Size, nearness: float = 1.0) -> Camera:
    """Returns a camera that sees nearly all of a scene, assuming that y points down.

    Args:
        points: points of the scene, one or more, world units.
        size: width and height of the image, pixels.
        nearness: factor by which the camera is closer to the centre of the scene.
    """
    low, high = np.percentile(np.asarray(points, np.float64), [1, 99], axis=0)
    centre, radius = (low + high) / 2, max(np.linalg.norm(high - low) / 2, 1e-6)
    focal = FOCAL * max(size)
    distance = radius / np.sin(np.arctan(min(size) / 2 / focal)) / nearness
    position = centre - distance * np.array(VIEW) / np.linalg.norm(VIEW)
    pose = look_at(*(jnp.asarray(v, jnp.float32) for v in (position, centre, (0, -1, 0))))
    return Camera.simple_pinhole(focal, pose, *size)


def focus_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Returns the point for `orbit` to turn around: the one that the cameras look at, world units.

    Raises:
        InputError: if there is no such point, see `cameras.rig.focus_of`.
    """
    point = rig.focus_of(cameras)
    if point is None:
        raise InputError(
            "orbit: the cameras look at no common point: all look the same way, or outwards. Use spiral or "
            "interpolate."
        )
    return point


def _fov(cameras: Sequence[Camera], size: Size) -> float:
    return float(np.median([Keyframe.of(camera, size).fov for camera in cameras]))


def _looking(position: np.ndarray, target: np.ndarray, up: np.ndarray, fov: float) -> Keyframe:
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    return Keyframe(
        position, Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1)), fov
    )
