"""A smooth flight through keyframes: cubic curves of positions, rotations and focal lengths."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from splatax.camera import Camera

Size = tuple[int, int]  # width and height, pixels


@dataclass(frozen=True)
class Key:
    """Where the camera is at one moment.

    Attributes:
        position: optical centre, world units.
        rotation: of camera axes (x right, y down, z forward) to the world's.
        fov: from the picture's top to its bottom, radians.
    """

    position: Float[np.ndarray, "3"]
    rotation: Rotation
    fov: float

    @classmethod
    def of(cls, camera: Camera, size: Size) -> "Key":
        """A camera as it is shown in a picture of another shape, which cuts off what does not fit: it
        never shows more than the camera saw. A principal point beside the middle is not kept."""
        focal = float(camera.fy) * max(size[0] / camera.width, size[1] / camera.height)
        pose = np.asarray(camera.cam_from_world, np.float64)
        rotation = Rotation.from_matrix(pose[:3, :3].T)
        return cls(-pose[:3, :3].T @ pose[:3, 3], rotation, 2 * np.arctan(size[1] / 2 / focal))

    def camera(self, size: Size) -> Camera:
        """The camera that takes a picture of this size."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation.as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ self.position
        focal = size[1] / 2 / np.tan(self.fov / 2)
        return Camera.simple_pinhole(focal, jnp.asarray(pose, jnp.float32), *size)


def interpolate(
    keys: Sequence[Key], times: npt.ArrayLike, moments: npt.ArrayLike, *, closed: bool = False
) -> list[Key]:
    """Where the camera is at each moment. It passes every key with a continuous velocity.

    Velocities at keys are those of Catmull and Rom, weighed by time: of the parabola through the key and
    its neighbours. Rotations follow de Casteljau's construction with slerp (Shoemake 1985), whose
    velocities at keys are the given ones too. Focal lengths change by equal factors in equal times.

    Args:
        keys: one or more.
        times: of the keys, increasing. For a closed path one more: when it is back at the first.
        moments: within those times.
        closed: the path ends where it began, without a jolt.
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
        Key(row[:3], rotation, 2 * np.arctan(np.exp(-row[3])))
        for row, rotation in zip(curve, turned, strict=True)
    ]


def _velocities(slopes: Float[np.ndarray, "k d"], gaps: Float[np.ndarray, " k"], closed: bool) -> np.ndarray:
    """At k + 1 keys, from the mean velocities between them."""
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
    share = ((when - at[segment]) / gaps[segment])[:, None]
    while len(points) > 1:
        points = [_slerp(a, b, share) for a, b in itertools.pairwise(points)]
    return points[0]


def _slerp(a: Rotation, b: Rotation, share: Float[np.ndarray, "n 1"]) -> Rotation:
    return a * Rotation.from_rotvec((a.inv() * b).as_rotvec() * share)
