"""LiDARs: tables of rays from one point, measured in a rendered panorama."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatax.cameras import Camera, panorama
from splatax.cameras.geometry import rays
from splatax.outputs import Rendering
from splatax.pytrees import pytree
from splatax.sensors.depth import COVERED, Frame
from splatax.sensors.protocol import Key, Plain

MOST_CORRECTION = 1.25  # of a range by its plane; planes that are seen at a grazing angle would ask for more


class Scan(NamedTuple):
    """One scan of a LiDAR, a row for each ray of its table.

    Attributes:
        ranges: distances along the rays, metres if the scene is; NaN where nothing is measured.
        points: the points that the rays meet, in the frame that the sensor says; NaN likewise.
        rows: the Gaussians that contribute most to the points, rows of the scene; -1 likewise.
    """

    ranges: Float[Array, " r"]
    points: Float[Array, "r 3"]
    rows: Int[Array, " r"]


@pytree
@dataclass(frozen=True)
class Lidar(Plain):
    """A LiDAR. Its measurement is a `Scan`.

    The surroundings are drawn once through an equirectangular lens. Each ray reads the pixel that it falls
    in, and meets the plane of the pixel's surface; the plane changes the range by a factor of at most 1.25.
    A pixel is pi / height radians wide. Finer structures are not resolved, and where Gaussians are smaller
    than a pixel, surfaces that are seen at a grazing angle appear too near: choose a larger height. All rays
    are cast at one time.

    Attributes:
        directions: rays in camera axes (x right, y down, z forward), of any length above 0.
        deviation: standard deviation of range noise, metres.
        least: smallest range.
        most: largest range.
        height: height of the panorama, pixels; its width is twice that (static).
        frame: of the points, "sensor" or "world" (static).
    """

    directions: Float[Array, "r 3"]
    deviation: float | Float[Array, ""] = 0.0
    least: float | Float[Array, ""] = 0.0
    most: float | Float[Array, ""] = jnp.inf
    height: int = field(default=256, metadata={"static": True})
    frame: Frame = field(default="sensor", metadata={"static": True})

    def __post_init__(self) -> None:
        known = isinstance(self.directions, np.ndarray | jax.Array)  # JAX also makes records of placeholders
        if known and not isinstance(self.directions, jax.core.Tracer):
            lengths = np.linalg.norm(np.asarray(self.directions, np.float64), axis=-1)
            if wrong := int(np.sum(~((lengths > 0) & np.isfinite(lengths)))):
                raise ValueError(
                    f"{wrong} of {lengths.size} directions of a LiDAR are not finite or have no length. "
                    "Leave them out."
                )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        return ("alpha", "median_surface_depth", "normals", "contributors")

    def views(self, camera: Camera) -> tuple[Camera, ...]:
        """Returns a panorama from the camera's place, in the camera's axes."""
        return (panorama(camera.cam_from_world, 2 * self.height, self.height),)

    @jax.default_matmul_precision("highest")
    def read(self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None) -> Scan:
        """Returns the scan."""
        (image,), (camera,) = drawn, views
        local = self.directions / jnp.linalg.norm(self.directions, axis=1, keepdims=True)
        pixels = jax.vmap(camera.to_pixel)(_off_the_poles(local))
        x = jnp.floor(pixels[:, 0]).astype(jnp.int32) % camera.width
        y = jnp.clip(jnp.floor(pixels[:, 1]).astype(jnp.int32), 0, camera.height - 1)
        along = local @ camera.rotation
        met, normal = rays(camera)[y, x], image.normals[y, x]
        towards = jnp.sum(along * normal, axis=1)
        factor = jnp.sum(met * normal, axis=1) / jnp.where(towards < 0, towards, -1e-9)
        factor = jnp.where(towards < 0, jnp.clip(factor, 1 / MOST_CORRECTION, MOST_CORRECTION), 1)
        ranges = image.median_surface_depth[y, x]
        valid = (image.alpha[y, x] >= COVERED) & (ranges > 0)
        ranges = ranges * factor
        valid &= (ranges >= self.least) & (ranges <= self.most)
        if key is not None:
            ranges = ranges + self.deviation * jax.random.normal(key, ranges.shape, ranges.dtype)
        ranges = jnp.where(valid, ranges, jnp.nan)
        world = self.frame == "world"
        points = ranges[:, None] * (along if world else local) + (camera.position[None] if world else 0)
        return Scan(ranges, points, jnp.where(valid, image.contributors.indices[y, x, 0], -1))


def spinning(elevations: Float[np.ndarray, " e"], azimuths: int) -> Float[np.ndarray, "r 3"]:
    """Returns the rays of a spinning LiDAR as a table, one elevation after another.

    Args:
        elevations: angles of the lasers above the horizon, radians; the horizon is the camera's x-z plane.
        azimuths: number of steps of a turn, from the camera's z axis to its x axis.
    """
    turn = 2 * math.pi * np.arange(azimuths) / azimuths
    up, around = (a.ravel() for a in np.meshgrid(np.asarray(elevations), turn, indexing="ij"))
    rows = np.stack([np.cos(up) * np.sin(around), -np.sin(up), np.cos(up) * np.cos(around)], axis=1)
    return rows.astype(np.float32)


def _off_the_poles(directions: Float[Array, "r 3"]) -> Float[Array, "r 3"]:
    """Returns directions with a finite longitude: those of the poles move by less than a float's rounding."""
    aside = jnp.abs(directions[:, 0]) + jnp.abs(directions[:, 2]) > 0
    return jnp.where(aside[:, None], directions, directions + jnp.array([[0, 0, 1e-7]], directions.dtype))
