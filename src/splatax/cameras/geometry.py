"""Projections of many points to one camera, of any lens, on NumPy arrays in double precision.

The camera's float32 numbers are what limits the precision of the results.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras.camera import Camera

LEAST = 1024  # points of a compiled program; numbers of points are padded to powers of two


def seen_at(
    camera: Camera, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Returns where a camera sees world points, pixels, and their depths; NaN where its lens does not.

    Points beside the image are seen too.
    """
    pixels, depths = _padded(_seen, camera, points)
    return pixels.astype(np.float64), depths.astype(np.float64)


def points_at(
    camera: Camera, pixels: Float[np.ndarray, "n 2"], depths: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Returns world points of these depths that a camera, in the middle of its exposure, sees at pixels."""
    local = _padded(_local, camera, np.column_stack([pixels, depths]))[0].astype(np.float64)
    pose = np.asarray(camera.cam_from_world, np.float64)
    return (local - pose[:3, 3]) @ pose[:3, :3]


def _padded(function, camera: Camera, rows: Float[np.ndarray, "n k"]) -> list[np.ndarray]:
    """Calls a compiled function with a number of rows that few programs serve."""
    n = len(rows)
    padded = np.zeros((max(LEAST, 1 << (max(n, 1) - 1).bit_length()), rows.shape[1]), np.float32)
    padded[:n] = rows
    return [np.asarray(result)[:n] for result in function(camera, padded)]


@jax.jit
def _seen(camera: Camera, points: Float[Array, "n 3"]) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    def one(point):
        seen = camera.lens.sees(camera.rotation @ point + camera.translation)
        ahead = camera.position + camera.rotation[2]
        local = camera.to_camera(jnp.where(seen, point, ahead))
        pixel, depth = camera.to_pixel(local), camera.lens.depth(local)
        return jnp.where(seen, pixel, jnp.nan), jnp.where(seen, depth, jnp.nan)

    return jax.vmap(one)(points)


@jax.jit
def _local(camera: Camera, rows: Float[Array, "n 3"]) -> tuple[Float[Array, "n 3"]]:
    return (jax.vmap(lambda row: camera.to_point(row[:2], row[2]))(rows),)


def ray(camera: Camera, pixel: Float[Array, "2"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Returns origin and direction of the ray through a pixel: a world point and a unit vector in the world.

    Rays of a camera that moves start where it stands when the pixel's row is exposed.
    """
    here = camera
    if camera.motion is not None:
        here = camera.at(camera.motion.time(pixel, *camera.size))
    near, far = (here.to_point(pixel, jnp.asarray(depth, pixel.dtype)) for depth in (0.0, 1.0))
    direction = here.rotation.T @ (far - near)
    return here.position + here.rotation.T @ near, direction / jnp.linalg.norm(direction)


@jax.jit
def rays(camera: Camera) -> Float[Array, "h w 3"]:
    """Returns the directions in the world, unit vectors, in which the centres of a camera's pixels look."""

    x, y = (jnp.arange(side, dtype=camera.fx.dtype) + 0.5 for side in (camera.width, camera.height))
    return jax.vmap(jax.vmap(lambda pixel: ray(camera, pixel)[1]))(jnp.stack(jnp.meshgrid(x, y), axis=-1))
