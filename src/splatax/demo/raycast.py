"""Photos of analytic surfaces with one lamp, its shadows, highlights and mirrors; and their geometry."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, UInt8

from splatax.cameras import Camera
from splatax.cameras.geometry import ray
from splatax.demo.scene import Scene
from splatax.demo.shapes import Point

SAMPLES = 3  # per side of a pixel
CLEARANCE = 1e-3  # distance from a surface at which rays leave it


class Seen(NamedTuple):
    """The first surface point on each ray.

    Attributes:
        color: RGB of the light that comes along the ray.
        point: position; not finite if the ray meets no surface.
        normal: unit normal on the side of the ray's origin; meaningless if the ray meets no surface.
        surface: index into `Scene.surfaces`; -1 if the ray meets no surface.
    """

    color: Float[Array, "*n 3"]
    point: Float[Array, "*n 3"]
    normal: Float[Array, "*n 3"]
    surface: Int32[Array, "*n"]


class Truth(NamedTuple):
    """Exact geometry at the centre of each pixel.

    Attributes:
        depth: by the lens, as `Rendering.depth` measures it; infinite without a surface.
        normals: unit normals in the world, towards the camera; zero without a surface.
        surfaces: index into `Scene.surfaces`; -1 without a surface.
    """

    depth: Float[Array, "h w"]
    normals: Float[Array, "h w 3"]
    surfaces: Int32[Array, "h w"]


@partial(jax.jit, static_argnames="scene")
def photograph(camera: Camera, scene: Scene) -> UInt8[Array, "h w c"]:
    """Returns the photo of a scene from a camera, averaged over the area of each pixel.

    The photo is RGB, or RGBA with straight alpha if the scene has no sky.
    """
    offsets = (jnp.arange(SAMPLES, dtype=jnp.float32) + 0.5) / SAMPLES
    x = (jnp.arange(camera.width, dtype=jnp.float32)[:, None] + offsets[None, :]).ravel()
    y = (jnp.arange(camera.height, dtype=jnp.float32)[:, None] + offsets[None, :]).ravel()
    pixels = jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = look(camera, pixels, scene)
    colors = _averaged(seen.color, camera)
    if scene.sky is None:
        alpha = _averaged(jnp.where(seen.surface < 0, 0.0, 1.0)[:, None], camera)
        colors = jnp.concatenate([colors / jnp.maximum(alpha, 1e-6), alpha], axis=-1)
    return jnp.round(255 * jnp.clip(colors, 0, 1)).astype(jnp.uint8)


@partial(jax.jit, static_argnames="scene")
def truth(camera: Camera, scene: Scene) -> Truth:
    """Returns the exact depth, normal and surface at the centre of each pixel."""
    x, y = (jnp.arange(size, dtype=jnp.float32) + 0.5 for size in (camera.width, camera.height))
    seen = look(camera, jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2), scene)
    met, size = seen.surface >= 0, (camera.height, camera.width)
    local = jax.vmap(camera.to_camera)(
        jnp.where(met[:, None], seen.point, camera.position + camera.rotation[2])
    )
    depth = jnp.where(met, jax.vmap(camera.lens.depth)(local), jnp.inf)
    normals = jnp.where(met[:, None], seen.normal, 0.0)
    return Truth(depth.reshape(size), normals.reshape(*size, 3), seen.surface.reshape(size))


@partial(jax.jit, static_argnames="scene")
def look(camera: Camera, pixels: Float[Array, "n 2"], scene: Scene) -> Seen:
    """Casts one ray through each of the pixel coordinates."""

    def one(pixel: Float[Array, "2"]) -> Seen:
        origin, direction = ray(camera, pixel)
        return trace(origin, direction, scene)

    return jax.vmap(one)(pixels)


def trace(origin: Point, direction: Point, scene: Scene, bounces: int = 1) -> Seen:
    """Casts one ray and shades the first surface that it meets (Phong 1975).

    Args:
        origin: start of the ray.
        direction: unit vector.
        scene: the surfaces and their light.
        bounces: number of mirror reflections that are followed.
    """
    distances = surface_distances(origin, direction, scene)
    nearest = jnp.argmin(distances)
    point = origin + distances[nearest] * direction
    albedo = jnp.stack([surface.texture(point) for surface in scene.surfaces])[nearest]
    normal = jnp.stack([surface.shape.normal(point) for surface in scene.surfaces])[nearest]
    gloss = jnp.array([surface.gloss for surface in scene.surfaces])[nearest]
    light = scene.light

    normal = jnp.where(normal @ direction > 0, -normal, normal)
    to_lamp = jnp.array(light.lamp) - point
    reach = jnp.linalg.norm(to_lamp)
    to_lamp = to_lamp / reach
    lit = jnp.where(jnp.min(surface_distances(point + CLEARANCE * normal, to_lamp, scene)) > reach, 1, 0)
    cosine = normal @ to_lamp
    mirrored = 2 * cosine * normal - to_lamp
    highlight = jnp.maximum(-mirrored @ direction, 0) ** light.shininess
    color = albedo * (light.ambient + light.diffuse * lit * jnp.maximum(cosine, 0)) + gloss * lit * highlight
    if bounces and any(surface.mirror for surface in scene.surfaces):
        mirror = jnp.array([surface.mirror for surface in scene.surfaces])[nearest]
        reflected = direction - 2 * (normal @ direction) * normal
        color += mirror * (trace(point + CLEARANCE * normal, reflected, scene, bounces - 1).color - color)
    met = jnp.isfinite(distances[nearest])
    beyond = scene.sky(direction) if scene.sky else jnp.zeros(3)
    surface = jnp.where(met, nearest, -1).astype(jnp.int32)
    return Seen(jnp.where(met, color, beyond), point, normal, surface)


def surface_distances(origin: Point, direction: Point, scene: Scene) -> Float[Array, " surfaces"]:
    """Returns the distance along a ray to each surface; infinite for surfaces that the ray misses."""
    return jnp.stack([surface.shape.distance(origin, direction) for surface in scene.surfaces])


@partial(jax.jit, static_argnames="scene")
def visible(camera: Camera, points: Float[Array, "n 3"], scene: Scene) -> Bool[Array, " n"]:
    """Returns a mask of the surface points that no surface hides from the camera."""

    def unobstructed(point: Point) -> Bool[Array, ""]:
        offset = point - camera.position
        reach = jnp.linalg.norm(offset)
        slack = 3e-3 * jnp.maximum(reach / 10, 1)
        return jnp.min(surface_distances(camera.position, offset / reach, scene)) > reach - slack

    return jax.vmap(unobstructed)(points)


def _averaged(values: Float[Array, "n c"], camera: Camera) -> Float[Array, "h w c"]:
    """Returns the mean over the samples of each pixel."""
    shape = (camera.height, SAMPLES, camera.width, SAMPLES, values.shape[1])
    return values.reshape(shape).mean(axis=(1, 3))
