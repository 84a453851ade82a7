"""Cameras, in the conventions of COLMAP and OpenCV."""

from dataclasses import dataclass, field, fields, is_dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras.lenses import Lens, Pinhole
from splatax.cameras.motion import RollingShutter
from splatax.math import rigid
from splatax.pytrees import pytree
from splatax.shapes import check_arrays, check_kind, check_size

SEARCHES = 6  # for the row that sees a point; the camera moves little during the exposure


@pytree
@dataclass(frozen=True)
class Camera:
    """Camera: pose, intrinsics, lens, motion during the exposure, and image size.

    Camera axes are x right, y down, z forward. Pixel coordinates have the image's top left corner
    at (0, 0), so the first pixel's centre is (0.5, 0.5). The lens maps a point in camera axes to the image
    plane at focal length one; pixel = (fx, fy) * place + (cx, cy). All fields except the size are traced:
    views of one size and kind of lens share one compiled program, and every number but `frame` can have a
    gradient. Views of different sizes share one program on a canvas, see `on_canvas`.

    Attributes:
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels.
        cam_from_world: rigid transform, p_cam = R p_world + t, as a 4 x 4 matrix.
        width, height: image size, pixels (static).
        lens: kind of lens and its coefficients; see `cameras.lenses`.
        motion: None if the whole image is exposed at once.
        frame: width and height of the part of the image, from its top left corner, that the view fills,
            pixels; None if it fills all of it. What lies beyond is not defined. It has no gradient.
    """

    fx: Float[Array, ""]
    fy: Float[Array, ""]
    cx: Float[Array, ""]
    cy: Float[Array, ""]
    cam_from_world: Float[Array, "4 4"]
    width: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    lens: Lens = Pinhole()
    motion: RollingShutter | None = None
    frame: Float[Array, "2"] | None = None

    @classmethod
    def simple_pinhole(
        cls, focal: float, cam_from_world: Float[Array, "4 4"], width: int, height: int
    ) -> "Camera":
        """Returns a camera with one focal length, pixels, and its principal point at the image's centre."""
        dtype = jax.dtypes.canonicalize_dtype(cam_from_world.dtype)
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

    @property
    def focal(self) -> Float[Array, "2"]:
        """Focal lengths (fx, fy), pixels."""
        return jnp.stack([self.fx, self.fy])

    @property
    def center(self) -> Float[Array, "2"]:
        """Principal point (cx, cy), pixels."""
        return jnp.stack([self.cx, self.cy])

    @property
    def size(self) -> Float[Array, "2"]:
        """Width and height of what the view fills of the image, pixels."""
        if self.frame is None:
            return jnp.array([self.width, self.height], self.fx.dtype)
        return jax.lax.stop_gradient(self.frame)

    def to_camera(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Returns a world point in camera axes, at the moment when its row of the image is exposed.

        A camera that moves must see the point in the middle of the exposure.
        """
        if self.motion is None:
            return self.rotation @ point + self.translation
        return self.at(self._time_of(point)).to_camera(point)

    def to_pixel(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns the pixel coordinates of a point in camera axes, which the lens must see."""
        return self.focal * self.lens.project(point) + self.center

    def to_point(self, pixel: Float[Array, "2"], depth: Float[Array, ""]) -> Float[Array, "3"]:
        """Returns the point in camera axes, of the lens's depth, that is seen at a pixel.

        It is the inverse of `to_pixel`.
        """
        return self.lens.unproject((pixel - self.center) / self.focal, depth)

    def at(self, time: Float[Array, ""]) -> "Camera":
        """Returns the camera as it stands at a time of the exposure, from -1/2 to 1/2, without motion."""
        if self.motion is None:
            return self
        pose = rigid.exponential(self.motion.twist * time) @ self.cam_from_world
        return replace(self, cam_from_world=pose, motion=None)

    def _time_of(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Returns when the row on which a world point is seen is exposed.

        It solves t = time(pixel(t)), whose right side hardly depends on t. The search has no derivative; two
        steps from its result, divided by the slope there, give the first two derivatives exactly.
        """

        def seen(camera, point, time):
            pixel = camera.to_pixel(camera.at(time).to_camera(point))
            return camera.motion.time(pixel, *camera.size)

        fixed = jax.lax.stop_gradient((self, point))
        zero = jnp.zeros((), point.dtype)
        time, _ = jax.lax.scan(lambda time, _: (seen(*fixed, time), None), zero, length=SEARCHES)
        _, slope = jax.jvp(lambda time: seen(*fixed, time), (time,), (jnp.ones_like(time),))
        for _ in range(2):
            time = time + (seen(self, point, time) - time) / (1 - slope)
        return time

    def resized(self, width: int, height: int) -> "Camera":
        """Returns the camera with the same view and another image size."""
        sx, sy = width / self.width, height / self.height
        frame = None if self.frame is None else self.frame * jnp.array([sx, sy], self.frame.dtype)
        return replace(
            self,
            fx=self.fx * sx,
            cx=self.cx * sx,
            fy=self.fy * sy,
            cy=self.cy * sy,
            width=width,
            height=height,
            frame=frame,
        )

    def on_canvas(self, width: int, height: int) -> "Camera":
        """Returns the camera with a larger image, whose top left part is the view; see `frame`.

        What the view shows does not change. Its own size becomes a traced number, so that views of many sizes
        on one canvas share compiled programs.

        Args:
            width, height: size of the canvas, pixels.

        Raises:
            ValueError: if the view does not fit, or the image repeats sideways, as that of a panorama does.
        """
        if width < self.width or height < self.height:
            raise ValueError(
                f"a view of {self.width} x {self.height} pixels does not fit on {width} x {height}."
            )
        if self.lens.PERIOD is not None:
            raise ValueError(
                f"the image of the lens {type(self.lens).__name__} repeats, so it needs no canvas"
            )
        return replace(self, width=width, height=height, frame=self.size)


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
        TypeError: if it is no camera.
        ValueError: if a shape or dtype is wrong, or the image has no size. Stacked cameras are refused too:
            use `jax.vmap`.
    """
    check_kind("the camera", camera, Camera, "Give one Camera, such as the `camera` of a view.")
    arrays = {name: (getattr(camera, name), "") for name in ("fx", "fy", "cx", "cy")}
    arrays["cam_from_world"] = (camera.cam_from_world, "4 4")
    if not isinstance(camera.lens, Lens):
        raise ValueError(
            f"Camera: its lens is {type(camera.lens).__name__}, which is not a lens. Choose one of "
            "splatax.cameras.lenses."
        )
    if camera.frame is not None:
        arrays["frame"] = (camera.frame, "2")
    for part in ("lens", "motion"):
        arrays |= _arrays_of(part, getattr(camera, part))
    check_arrays("Camera", arrays)
    check_size("Camera", camera.width, camera.height)
    return camera


def _arrays_of(owner: str, record: Lens | RollingShutter | None) -> dict[str, tuple[Array, str]]:
    """Returns the arrays of a record with the shapes that its fields declare, by name."""
    return {
        f"{owner}.{field.name}": (getattr(record, field.name), getattr(field.type, "dim_str", ""))
        for field in (fields(record) if is_dataclass(record) else ())
        if "static" not in field.metadata
    }
