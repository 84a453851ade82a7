"""What cameras see of a scene: depth and colour of each pixel, rendered when they are needed."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.rendering import Renderer

DEPTH = "median_depth"  # output that meshes are made from
JUMP = 0.01  # second difference of the reciprocal depth, as a fraction of it, between surfaces
HALF = 0.5  # least alpha of a pixel whose depth is used
Item = TypeVar("Item")
Watch = Callable[[Sequence[Item], str], Iterable[Item]]  # such as `rich.progress.track`


class Picture(NamedTuple):
    """Depth and colour of one view.

    Attributes:
        depth: by the camera's lens, world units; 0 where no surface is seen.
        rgb: sRGB in [0, 1].
    """

    depth: Float[np.ndarray, "h w"]
    rgb: Float[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class DepthView:
    """A camera and what it sees.

    Attributes:
        camera: of any lens.
        read: function that returns depth and colour. It is called several times, so that memory holds one
            view.
    """

    camera: Camera
    read: Callable[[], Picture]


def depth_views(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    renderer: Renderer = Renderer(),
    depth: str = DEPTH,
) -> tuple[DepthView, ...]:
    """Returns views of a scene that are rendered when they are read.

    Args:
        gaussians: the scene.
        cameras: cameras to render from.
        renderer: background and backend.
        depth: name of the output that is the depth. Pixels that are less than half opaque have none.

    Raises:
        ValueError: if there is no output of that name.
    """
    return tuple(
        DepthView(camera, partial(rendered, gaussians, camera, renderer, depth)) for camera in cameras
    )


def rendered(gaussians: Gaussians, camera: Camera, renderer: Renderer, depth: str) -> Picture:
    """Renders depth and colour of one view."""
    drawn = renderer(gaussians, camera, outputs=("rgb", "alpha", depth))
    depths = np.asarray(drawn.images[depth], np.float32)
    opaque = (np.asarray(drawn.alpha) >= HALF) & np.isfinite(depths) & (depths > 0)
    return Picture(np.where(opaque, depths, 0), np.clip(np.asarray(drawn.rgb, np.float32), 0, 1))


def unwatched(items: Sequence[Item], activity: str) -> Iterable[Item]:
    """Returns the items, and shows no progress."""
    return items


@jax.jit
def points_of(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Returns the world point that is seen at the centre of each pixel; NaN where there is no depth."""
    x, y = (jnp.arange(side, dtype=depth.dtype) + 0.5 for side in (camera.width, camera.height))

    def one(pixel: Float[Array, "2"], value: Float[Array, ""]) -> Float[Array, "3"]:
        here = camera
        if camera.motion is not None:
            here = camera.at(camera.motion.time(pixel, camera.width, camera.height))
        local = here.to_point(pixel, value)
        point = here.rotation.T @ (local - here.translation)
        return jnp.where(value > 0, point, jnp.nan)

    return jax.vmap(jax.vmap(one))(jnp.stack(jnp.meshgrid(x, y), axis=-1), depth)


@jax.jit
def normals_of(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Returns unit normals of a depth map, in the world and towards the camera.

    They are at right angles to the differences between the points of the pixels on both sides. They are NaN
    at the border of the image, and where a pixel on one side has no depth.
    """
    points = points_of(camera, depth)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    cross = jnp.cross(across, down)
    normals = cross / jnp.linalg.norm(cross, axis=-1, keepdims=True)
    rays = points[1:-1, 1:-1] - camera.position
    normals = jnp.where(jnp.sum(normals * rays, axis=-1, keepdims=True) > 0, -normals, normals)
    return jnp.pad(normals, ((1, 1), (1, 1), (0, 0)), constant_values=jnp.nan)


@jax.jit
def jumps_of(depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Returns where depth jumps, from one surface to another or to none.

    There, the second difference of the reciprocal depth, which is zero on planes that a pinhole sees, is
    larger than a hundredth of it.
    """
    nearness = jnp.where(depth > 0, 1 / jnp.where(depth > 0, depth, 1), 0)
    jumps = depth <= 0
    for axis in (0, 1):
        second = jnp.abs(jnp.diff(nearness, 2, axis=axis))
        margin = [(1, 1) if axis == i else (0, 0) for i in range(2)]
        jumps |= jnp.pad(second, margin) > JUMP * nearness
    return jumps


@jax.jit
def sampled(depth: Float[Array, "h w"], pixels: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """Returns depth between pixel centres; 0 where there is none, and outside the image.

    The reciprocal of the depth is interpolated, which is linear on planes that a pinhole sees. Beside jumps,
    the depth of the nearest pixel is taken.
    """
    height, width = depth.shape
    inside = jnp.all((pixels >= 0) & (pixels < jnp.array([width, height], pixels.dtype)), axis=1)
    x, y = (jnp.where(inside, pixels[:, i], 0) for i in range(2))
    left, top = (jnp.floor(place - 0.5).astype(jnp.int32) for place in (x, y))
    right_share, bottom_share = x - 0.5 - left, y - 0.5 - top
    smooth_nearness = jnp.where(jumps_of(depth), jnp.nan, 1 / depth).ravel()
    mean = jnp.zeros_like(x)
    for column, across in ((left, 1 - right_share), (left + 1, right_share)):
        for row, along in ((top, 1 - bottom_share), (top + 1, bottom_share)):
            at = jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)
            mean += across * along * smooth_nearness[at]
    nearest = depth.ravel()[y.astype(jnp.int32) * width + x.astype(jnp.int32)]
    return jnp.where(inside, jnp.where(jnp.isnan(mean), nearest, 1 / mean), 0)
