"""Views of a ball, with exact depth and colour, through several lenses."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera, look_at
from splatax.cameras.geometry import ray
from splatax.cameras.lenses import Pinhole
from splatax.mesh.views import DepthView, Picture

RADIUS, CENTRE = 1.0, np.array([0.3, -0.2, 0.1], np.float32)
DIRECTIONS = np.array([*np.eye(3), *-np.eye(3), *np.array(list(np.ndindex(2, 2, 2))) - 0.5 + 1e-3])


def looking_at_ball(direction, distance=3.0, side=64, focal=1.1, lens=None) -> Camera:
    direction = jnp.asarray(direction / np.linalg.norm(direction), jnp.float32)
    pose = look_at(CENTRE + distance * direction, jnp.asarray(CENTRE), jnp.array([0.1, 0.9, 0.3]))
    camera = Camera.simple_pinhole(focal * side, pose, side, side)
    return replace(camera, lens=lens or Pinhole())


@jax.jit
def ball_depth(camera: Camera, scale=1.0):
    """Depth of the nearest point of the ball at each pixel; 0 beside it."""

    def one(pixel):
        origin, direction = ray(camera, pixel)
        offset = origin - CENTRE
        middle = -offset @ direction
        half = RADIUS**2 - (offset + middle * direction) @ (offset + middle * direction)
        point = origin + (middle - jnp.sqrt(jnp.maximum(half, 0))) * direction
        return jnp.where(half > 0, scale * camera.lens.depth(camera.to_camera(point)), 0)

    x, y = (jnp.arange(side, dtype=jnp.float32) + 0.5 for side in (camera.width, camera.height))
    return jax.vmap(jax.vmap(one))(jnp.stack(jnp.meshgrid(x, y), axis=-1))


def read(camera: Camera) -> Picture:
    depth = np.asarray(ball_depth(camera))
    return Picture(depth, np.full((*depth.shape, 3), (1.0, 0.5, 0.0), np.float32))


def ball_views(directions=DIRECTIONS, **options) -> list[DepthView]:
    cameras = [looking_at_ball(direction, **options) for direction in directions]
    return [DepthView(camera, partial(read, camera)) for camera in cameras]
