"""Cameras as one array of numbers, for foreign projections, in the order of `CameraField` in native/."""

import math
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.cameras.lenses import Lens, OpenCV, Pinhole, opencv
from splatax.cameras.lenses.distortion import Distorted
from splatax.footprints import visible_plane
from splatax.pytrees import pytree

POSE_END = 19  # numbers of a camera before those of its lens
PackedCamera = Float[Array, " k"]  # fx, fy, cx, cy, rotation by rows, translation, position; then the lens's


@pytree
@dataclass(frozen=True)
class Boxed(OpenCV):
    """OpenCV's lens with the box of slopes that was found for a camera.

    Attributes:
        corners: lowest and highest slopes at which the Jacobian is taken.
    """

    corners: Float[Array, "2 2"]

    def box(self, low: Float[Array, "2"], high: Float[Array, "2"]) -> tuple[Array, Array]:
        """Returns the box that was found."""
        return self.corners[0], self.corners[1]


@dataclass(frozen=True)
class Layout:
    """The meaning of the numbers of a packed camera. Hashable.

    Attributes:
        width, height: of the image, pixels.
        lens: pytree structure of the lens.
        shapes: of the lens's arrays.
    """

    width: int
    height: int
    lens: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, camera: Camera) -> "Layout":
        """Returns the layout of a camera's numbers."""
        leaves, lens = jax.tree.flatten(packed_lens(camera))
        return cls(camera.width, camera.height, lens, tuple(leaf.shape for leaf in leaves))

    def camera(self, numbers: PackedCamera) -> Camera:
        """Returns the camera of packed numbers; the inverse of `packed`."""
        fx, fy, cx, cy = numbers[:4]
        pose = jnp.eye(4, dtype=numbers.dtype).at[:3, :3].set(numbers[4:13].reshape(3, 3))
        pose = pose.at[:3, 3].set(numbers[13:16])
        ends = np.cumsum([POSE_END, *(math.prod(shape) for shape in self.shapes)])
        parts = [
            numbers[start:end].reshape(shape)
            for start, end, shape in zip(ends[:-1], ends[1:], self.shapes, strict=True)
        ]
        lens = jax.tree.unflatten(self.lens, parts)
        if isinstance(lens, OpenCV):
            own = {field.name: getattr(lens, field.name) for field in fields(lens)}
            lens = Boxed(**own, corners=numbers[ends[-1] + 1 :].reshape(2, 2))
        return Camera(fx, fy, cx, cy, pose, self.width, self.height, lens)


def packed_lens(camera: Camera) -> Lens:
    """Returns the lens through which kernels project for a camera.

    Kernels find a pinhole's box of slopes from the size of the image. The box of OpenCV's lens is packed with
    the camera. A pinhole on a canvas, whose box is that of its frame, is therefore packed as OpenCV's lens.
    """
    if camera.frame is not None and isinstance(camera.lens, Pinhole):
        return opencv(dtype=camera.fx.dtype)
    return camera.lens


def packed(camera: Camera) -> PackedCamera:
    """Returns the numbers of a camera as one array, as `CameraField` and the lenses in native/ order them."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    return jnp.concatenate(
        [
            jnp.stack(numbers),
            jnp.ravel(camera.rotation),
            camera.translation,
            camera.position,
            *_lens_numbers(camera),
        ]
    )


def _lens_numbers(camera: Camera) -> list[Float[Array, " _"]]:
    """Returns the coefficients of a lens, where it folds, and the box of slopes of a perspective."""
    lens = packed_lens(camera)
    if not isinstance(lens, Distorted):
        return []
    numbers = [jnp.ravel(leaf) for leaf in jax.tree.leaves(lens)]
    numbers.append(jnp.reshape(lens.rise(camera.fx.dtype).limit, 1))
    if isinstance(lens, OpenCV):
        numbers += lens.box(*visible_plane(camera))
    return numbers
