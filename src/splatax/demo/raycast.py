"""Photos of analytic surfaces with one lamp, its shadows, and view-dependent highlights."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from splatax.cameras import Camera
from splatax.demo.shapes import Point
from splatax.demo.still_life import STILL_LIFE

LAMP = (-0.9, -2.2, 3.2)
AMBIENT, DIFFUSE = 0.45, 0.65
SHININESS = 50
BEYOND = (0.05, 0.06, 0.08)  # colour of rays that meet no surface
SAMPLES = 3  # per side of a pixel


class Seen(NamedTuple):
    """Colour and position of the first surface point on a ray; the position is not finite without one."""

    color: Float[Array, "*n 3"]
    point: Float[Array, "*n 3"]


@jax.jit
def photograph(camera: Camera) -> UInt8[Array, "h w 3"]:
    """Returns the photo of the still life from a camera, averaged over the area of each pixel."""
    offsets = (jnp.arange(SAMPLES, dtype=jnp.float32) + 0.5) / SAMPLES
    x = (jnp.arange(camera.width, dtype=jnp.float32)[:, None] + offsets[None, :]).ravel()
    y = (jnp.arange(camera.height, dtype=jnp.float32)[:, None] + offsets[None, :]).ravel()
    pixels = jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2)
    colors = look(camera, pixels).color.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3)
    return jnp.round(255 * jnp.clip(colors.mean(axis=(1, 3)), 0, 1)).astype(jnp.uint8)


@jax.jit
def look(camera: Camera, pixels: Float[Array, "n 2"]) -> Seen:
    """Casts one ray through each of the pixel coordinates."""

    def one(pixel: Float[Array, "2"]) -> Seen:
        direction = camera.rotation.T @ camera.to_point(pixel, jnp.ones((), pixel.dtype))
        return trace(camera.position, direction / jnp.linalg.norm(direction))

    return jax.vmap(one)(pixels)


def trace(origin: Point, direction: Point) -> Seen:
    """Casts one ray and shades the first surface that it meets (Phong 1975)."""
    distances = surface_distances(origin, direction)
    nearest = jnp.argmin(distances)
    point = origin + distances[nearest] * direction
    albedo = jnp.stack([surface.texture(point) for surface in STILL_LIFE])[nearest]
    normal = jnp.stack([surface.shape.normal(point) for surface in STILL_LIFE])[nearest]
    gloss = jnp.array([surface.gloss for surface in STILL_LIFE])[nearest]

    normal = jnp.where(normal @ direction > 0, -normal, normal)
    to_lamp = jnp.array(LAMP) - point
    reach = jnp.linalg.norm(to_lamp)
    to_lamp = to_lamp / reach
    lit = jnp.where(jnp.min(surface_distances(point + 1e-3 * normal, to_lamp)) > reach, 1, 0)
    cosine = normal @ to_lamp
    mirrored = 2 * cosine * normal - to_lamp
    highlight = jnp.maximum(-mirrored @ direction, 0) ** SHININESS
    color = albedo * (AMBIENT + DIFFUSE * lit * jnp.maximum(cosine, 0)) + gloss * lit * highlight
    return Seen(jnp.where(jnp.isfinite(distances[nearest]), color, jnp.array(BEYOND)), point)


def surface_distances(origin: Point, direction: Point) -> Float[Array, " surfaces"]:
    """Returns the distance along a ray to each surface; infinite for surfaces that the ray misses."""
    return jnp.stack([surface.shape.distance(origin, direction) for surface in STILL_LIFE])


@jax.jit
def visible(camera: Camera, points: Float[Array, "n 3"]) -> Bool[Array, " n"]:
    """Returns a mask of the surface points that no surface hides from the camera."""

    def unobstructed(point: Point) -> Bool[Array, ""]:
        offset = point - camera.position
        reach = jnp.linalg.norm(offset)
        return jnp.min(surface_distances(camera.position, offset / reach)) > reach - 3e-3

    return jax.vmap(unobstructed)(points)
