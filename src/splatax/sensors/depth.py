"""Depth cameras: depth along the axis or the ray, normals, and point clouds; noise and dropouts."""

from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt16

from splatax.cameras import Camera
from splatax.cameras.geometry import rays
from splatax.outputs import Rendering
from splatax.pytrees import pytree
from splatax.sensors.protocol import Key, Plain
from splatax.surfaces import pixel_centers, positions_of

Frame = Literal["sensor", "world"]
Surface = Literal["depth", "median_depth", "surface_depth", "median_surface_depth"]
COVERED = 0.5  # least alpha of a pixel with a surface
MOST_MILLIMETRES = 65_535  # of 16 bits


@pytree
@dataclass(frozen=True)
class DepthNoise:
    """Noise of a depth camera: axial noise that grows with z^2, and pixels without a measurement.

    The defaults for axial noise are those of Nguyen et al. (2012) for structured light: 1.2 mm + 1.9 mm at
    one metre beyond 0.4 m.

    Attributes:
        least: standard deviation of the depth at `nearest`, metres.
        quadratic: its growth, 1 / metres: deviation = least + quadratic (z - nearest)^2.
        nearest: depth from which the deviation grows, metres.
        grazing: angle between the ray and the surface's normal, radians, from which nothing is measured.
        edge: relative step of depth to one of the four neighbours from which nothing is measured.
        dropout: fraction of the other pixels in which nothing is measured.
    """

    least: float | Float[Array, ""] = 0.0012
    quadratic: float | Float[Array, ""] = 0.0019
    nearest: float | Float[Array, ""] = 0.4
    grazing: float | Float[Array, ""] = 1.4
    edge: float | Float[Array, ""] = 0.1
    dropout: float | Float[Array, ""] = 0.0

    def apply(
        self, depth: Float[Array, "h w"], cosine: Float[Array, "h w"], valid: Bool[Array, "h w"], key: Key
    ) -> tuple[Float[Array, "h w"], Bool[Array, "h w"]]:
        """Returns noisy depth, and where it is still measured.

        Args:
            depth: metres; anything where it is not valid.
            cosine: of the angle between the ray and the surface's normal.
            valid: where there is a surface in range.
            key: random key.
        """
        normal, uniform = jax.random.split(key)
        deviation = self.least + self.quadratic * jnp.square(jnp.maximum(depth - self.nearest, 0))
        noisy = depth + deviation * jax.random.normal(normal, depth.shape, depth.dtype)
        kept = jax.random.uniform(uniform, depth.shape, depth.dtype) >= self.dropout
        return noisy, valid & kept & (cosine > jnp.cos(self.grazing)) & ~_edges(depth, valid, self.edge)


@pytree
@dataclass(frozen=True)
class Depth(Plain):
    """A depth camera. Its measurement is an image [h w], in metres if the scene is.

    A pixel is measured if the surface fills at least half of it and lies in range. Other pixels hold
    `invalid`: 0 or NaN, as ROS REP 118 has them in images of integers and of floats.

    Attributes:
        noise: noise; None for none.
        least: smallest depth in range.
        most: largest depth in range.
        along: "axis" for z in camera axes, "ray" for the distance along the pixel's ray (static).
        invalid: value of pixels that are not measured, 0 or NaN (static).
        surface: output of `render` that is measured (static). The median of the surfaces does not mix the
            two sides of an edge.
    """

    noise: DepthNoise | None = None
    least: float | Float[Array, ""] = 0.0
    most: float | Float[Array, ""] = jnp.inf
    along: Literal["axis", "ray"] = field(default="axis", metadata={"static": True})
    invalid: float = field(default=0.0, metadata={"static": True})
    surface: Surface = field(default="median_surface_depth", metadata={"static": True})

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        return ("alpha", self.surface, *(("normals",) if self.noise else ()))

    def read(
        self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None
    ) -> Float[Array, "h w"]:
        """Returns the depth image."""
        (image,), (camera,) = drawn, views
        depth = image.images[self.surface]
        covered = (image.alpha >= COVERED) & (depth > 0)
        points = local_points(camera, jnp.where(covered, depth, 1))
        depth = points[..., 2] if self.along == "axis" else travelled(camera, points)
        valid = covered & (depth >= self.least) & (depth <= self.most)
        if self.noise is not None and key is not None:
            cosine = -jnp.sum(image.normals * rays(camera), axis=-1)
            depth, valid = self.noise.apply(depth, cosine, valid, key)
        return jnp.where(valid, depth, self.invalid)


@pytree
@dataclass(frozen=True)
class Normals(Plain):
    """Surface normals. The measurement is an image [h w 3] of unit vectors; 0 where there is no surface.

    Attributes:
        frame: "sensor" for camera axes, "world" for those of the scene (static).
    """

    frame: Frame = field(default="sensor", metadata={"static": True})

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        return ("alpha", "normals")

    def read(
        self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None
    ) -> Float[Array, "h w 3"]:
        """Returns the normals, towards the camera."""
        (image,), (camera,) = drawn, views
        normals = image.normals if self.frame == "world" else _turned(image.normals, camera)
        return jnp.where((image.alpha >= COVERED)[..., None], normals, 0)


@pytree
@dataclass(frozen=True)
class PointCloud(Plain):
    """An organized point cloud. The measurement is [h w 3], one point for each pixel; NaN where invalid.

    Points in the sensor's frame are in the axes of the camera as it stands in the middle of its exposure.

    Attributes:
        depth: the depth camera that measures the points; its noise acts along its `along`.
        frame: "sensor" or "world" (static).
    """

    depth: Depth = Depth()
    frame: Frame = field(default="sensor", metadata={"static": True})

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        return self.depth.outputs

    def read(
        self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None
    ) -> Float[Array, "h w 3"]:
        """Returns the points."""
        (image,), (camera,) = drawn, views
        true = image.images[self.depth.surface]
        known = true > 0
        lens_depth = jnp.where(known, true, 1)
        measured = self.depth.read(drawn, views, key)
        valid = known & (measured > 0)  # false for NaN
        points = local_points(camera, lens_depth)
        exact = points[..., 2] if self.depth.along == "axis" else travelled(camera, points)
        # Central lenses scale depth, distance and z of a ray's points alike; the parallel lens has depth z.
        factor = jnp.where(valid, measured / jnp.where(exact != 0, exact, 1), 1)
        points = positions_of(camera, lens_depth * factor)
        if self.frame == "sensor":
            points = _turned(points, camera) + camera.translation[None, None]
        return jnp.where(valid[..., None], points, jnp.nan)


@partial(jax.jit, inline=True)  # as in math/quaternions.py
def local_points(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Returns the points of a depth image in camera axes, at the moment when their row is exposed.

    Args:
        camera: of the image's size.
        depth: by the lens, above 0.
    """
    pixels = pixel_centers(camera.width, camera.height, depth.dtype)
    return jax.vmap(jax.vmap(camera.to_point))(pixels, depth)


def travelled(camera: Camera, points: Float[Array, "h w 3"]) -> Float[Array, "h w"]:
    """Returns the distances along rays to points in camera axes, which are not 0."""
    return jnp.linalg.norm(points, axis=-1) if camera.lens.CENTRAL else points[..., 2]


def millimetres(depth: Float[Array, "*n"]) -> UInt16[Array, "*n"]:
    """Returns depth in whole millimetres of 16 bits, as in ROS images of type 16UC1.

    Values that are NaN, not above 0, or above 65.535 m become 0, which stands for no measurement.
    """
    rounded = jnp.round(1000 * depth)
    held = (rounded > 0) & (rounded <= MOST_MILLIMETRES)  # false for NaN
    return jnp.where(held, rounded, 0).astype(jnp.uint16)


@jax.default_matmul_precision("highest")
def _turned(vectors: Float[Array, "h w 3"], camera: Camera) -> Float[Array, "h w 3"]:
    """Returns vectors of the world in camera axes."""
    return jnp.einsum("ij,hwj->hwi", camera.rotation, vectors)


def _edges(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], step: float | Float[Array, ""]
) -> Bool[Array, "h w"]:
    """Returns where a pixel is farther than one of its neighbours by more than a fraction of its depth."""
    far = jnp.where(valid, depth, jnp.inf)
    padded = jnp.pad(far, 1, constant_values=jnp.inf)
    around = jnp.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    return depth - jnp.min(around, axis=0) > step * depth
