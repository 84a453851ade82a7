"""Smooth interpolation of keyframes: cubic curves of position, rotation and focal length."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera, as_pinhole

Size = tuple[int, int]  # width and height, pixels


@dataclass(frozen=True)
class Keyframe:
    """Pose and field of view of the camera at one time.

    Attributes:
        position: optical centre, world units.
        rotation: from camera axes (x right, y down, z forward) to world axes.
        fov: vertical field of view, radians.
    """

    position: Float[np.ndarray, "3"]
    rotation: Rotation
    fov: float

    @classmethod
    def of(cls, camera: Camera, size: Size) -> "Keyframe":
        """Returns the keyframe of a camera, for frames of another size.

        The frame is cropped to its aspect ratio, so it never shows more than the camera saw. An
        off-centre principal point is lost.

        Args:
            camera: the camera.
            size: width and height of the frames, pixels.
        """
        camera = as_pinhole(camera)
        focal = float(camera.fy) * max(size[0] / camera.width, size[1] / camera.height)
        pose = np.asarray(camera.cam_from_world, np.float64)
        rotation = Rotation.from_matrix(pose[:3, :3].T)
        return cls(-pose[:3, :3].T @ pose[:3, 3], rotation, 2 * np.arctan(size[1] / 2 / focal))

    def camera(self, size: Size) -> Camera:
        """Returns the camera for a frame of this size, width and height in pixels."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation.as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ self.position
        focal = size[1] / 2 / np.tan(self.fov / 2)
        return Camera.simple_pinhole(focal, jnp.asarray(pose, jnp.float32), *size)


def interpolate(
    keys: Sequence[Keyframe], times: npt.ArrayLike, moments: npt.ArrayLike, *, closed: bool = False
) -> list[Keyframe]:
    """Interpolates keyframes at given times. The trajectory passes every keyframe with a continuous velocity.

    The velocities at keyframes are those of Catmull and Rom for unequal intervals: of the parabola
    through the keyframe and its two neighbours. Rotations follow de Casteljau's construction with slerp
    (Shoemake 1985), which has the same velocities at the keyframes. Focal lengths are interpolated
    geometrically.

    Args:
        keys: keyframes, one or more.
        times: one increasing time for each keyframe. A closed trajectory needs one more: the time at
            which it returns to the first keyframe.
        moments: times to interpolate at, within the range of `times`.
        closed: whether the trajectory returns to its start with a continuous velocity.

    Returns:
        One keyframe for each of `moments`.
    """
    count = len(keys)
    chosen = [*range(count), 0] if closed else list(range(count))
    if len(chosen) == 1:
        return [keys[0]] * len(np.asarray(moments))
    at, when = np.asarray(times, np.float64), np.asarray(moments, np.float64)
    rotations = Rotation.concatenate([keys[i].rotation for i in chosen])
    values = np.array([[*keys[i].position, -np.log(np.tan(keys[i].fov / 2))] for i in chosen])
    gaps = np.diff(at)
    velocities = _velocities(np.diff(values, axis=0) / gaps[:, None], gaps, closed)
    curve = CubicHermiteSpline(at, values, velocities)(when)
    turned = _turn(rotations, at, when, closed)
    return [
        Keyframe(row[:3], rotation, 2 * np.arctan(np.exp(-row[3])))
        for row, rotation in zip(curve, turned, strict=True)
    ]


def _velocities(slopes: Float[np.ndarray, "k d"], gaps: Float[np.ndarray, " k"], closed: bool) -> np.ndarray:
    """Returns the velocities at k + 1 keyframes from the mean velocities of the k intervals between them."""
    first, last = (slopes[-1:], slopes[:1]) if closed else (slopes[:1], slopes[-1:])
    before, after = np.concatenate([first, slopes]), np.concatenate([slopes, last])
    gap_before = np.concatenate([gaps[-1:] if closed else gaps[:1], gaps])[:, None]
    gap_after = np.concatenate([gaps, gaps[:1] if closed else gaps[-1:]])[:, None]
    return (gap_after * before + gap_before * after) / (gap_before + gap_after)


def _turn(rotations: Rotation, at: np.ndarray, when: np.ndarray, closed: bool) -> Rotation:
    steps = (rotations[:-1].inv() * rotations[1:]).as_rotvec()  # about axes of the camera
    gaps = np.diff(at)
    velocities = _velocities(steps / gaps[:, None], gaps, closed)
    segment = np.clip(np.searchsorted(at, when, side="right") - 1, 0, len(gaps) - 1)
    third = gaps[segment, None] / 3
    start, end = rotations[segment], rotations[segment + 1]
    points = [
        start,
        start * Rotation.from_rotvec(velocities[segment] * third),
        end * Rotation.from_rotvec(-velocities[segment + 1] * third),
        end,
    ]
    fraction = ((when - at[segment]) / gaps[segment])[:, None]
    while len(points) > 1:
        points = [_slerp(a, b, fraction) for a, b in itertools.pairwise(points)]
    return points[0]


def _slerp(a: Rotation, b: Rotation, fraction: Float[np.ndarray, "n 1"]) -> Rotation:
    return a * Rotation.from_rotvec((a.inv() * b).as_rotvec() * fraction)
