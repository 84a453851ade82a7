"""Pinhole cameras, in the conventions of COLMAP and OpenCV."""

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.shapes import check_arrays, check_size


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    """Pinhole camera: pose, intrinsics and image size.

    Camera axes are x right, y down, z forward. Pixel coordinates have the image's top left corner
    at (0, 0), so the first pixel's centre is (0.5, 0.5). All fields except the size are traced: views of one
    size share one compiled program, and every traced number can have a gradient.

    Attributes:
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels.
        cam_from_world: rigid transform, p_cam = R p_world + t, as a 4 x 4 matrix.
        width, height: image size, pixels (static).
    """

    fx: Float[Array, ""]
    fy: Float[Array, ""]
    cx: Float[Array, ""]
    cy: Float[Array, ""]
    cam_from_world: Float[Array, "4 4"]
    width: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})

    @classmethod
    def simple_pinhole(
        cls, focal: float, cam_from_world: Float[Array, "4 4"], width: int, height: int
    ) -> "Camera":
        """Returns a camera with one focal length, pixels, and its principal point at the image's centre."""
        dtype = cam_from_world.dtype
        f, cx, cy = (jnp.asarray(value, dtype) for value in (focal, width / 2, height / 2))
        return cls(f, f, cx, cy, cam_from_world, width, height)

    @property
    def rotation(self) -> Float[Array, "3 3"]:
        """Rotation from world to camera axes."""
        return self.cam_from_world[:3, :3]

    @property
    def translation(self) -> Float[Array, "3"]:
        """World origin in camera axes."""
        return self.cam_from_world[:3, 3]

    @property
    def position(self) -> Float[Array, "3"]:
        """Optical centre in the world, -R^T t."""
        return -self.rotation.T @ self.translation

    def to_camera(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Returns a world point in camera axes."""
        return self.rotation @ point + self.translation

    def to_pixel(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns the pixel coordinates of a point in camera axes, which must be in front of the camera."""
        x, y, z = point
        return jnp.array([self.fx * x / z + self.cx, self.fy * y / z + self.cy])

    def resized(self, width: int, height: int) -> "Camera":
        """Returns the camera with the same view and another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            cx=self.cx * sx,
            fy=self.fy * sy,
            cy=self.cy * sy,
            width=width,
            height=height,
        )


def look_at(
    position: Float[Array, "3"], target: Float[Array, "3"], up: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    """Returns `cam_from_world` of a camera at `position` that looks at `target`, with `up` at its top."""
    forward = (target - position) / jnp.linalg.norm(target - position)
    right = jnp.cross(forward, up)
    right = right / jnp.linalg.norm(right)
    rotation = jnp.stack([right, jnp.cross(forward, right), forward])
    top = jnp.concatenate([rotation, -(rotation @ position)[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], top.dtype)])


def checked(camera: Camera) -> Camera:
    """Checks that the camera is one camera whose numbers have one dtype, and returns it.

    It checks only shapes and dtypes, so it works on traced arrays.

    Raises:
        ValueError: if a shape or dtype is wrong, or the image has no size. Stacked cameras are refused too:
            use `jax.vmap`.
    """
    numbers = {name: (getattr(camera, name), "") for name in ("fx", "fy", "cx", "cy")}
    check_arrays("Camera", {**numbers, "cam_from_world": (camera.cam_from_world, "4 4")})
    check_size("Camera", camera.width, camera.height)
    return camera
