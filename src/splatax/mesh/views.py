"""Views of a scene: the depth and colour that cameras see, rendered when they are needed."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.geometry_scores import DEPTH, HALF
from splatax.rendering import Renderer

JUMP = 0.01  # second difference of the reciprocal depth, as a fraction of it, between surfaces
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
    inside = jnp.all((pixels >= 0) & (pixels < jnp.array([[width, height]], pixels.dtype)), axis=1)
    x, y = (jnp.where(inside, pixels[:, i], 0) for i in range(2))
    left, top = jnp.floor(x - 0.5), jnp.floor(y - 0.5)
    to_right, to_bottom = x - 0.5 - left, y - 0.5 - top
    smooth_nearness = jnp.where(jumps_of(depth), jnp.nan, 1 / depth).ravel()
    mean = jnp.zeros_like(x)
    for column, across in ((left, 1 - to_right), (left + 1, to_right)):
        for row, along in ((top, 1 - to_bottom), (top + 1, to_bottom)):
            at = row_major(jnp.clip(column, 0, width - 1), jnp.clip(row, 0, height - 1), width)
            mean += across * along * smooth_nearness[at]
    nearest = depth.ravel()[row_major(x, y, width)]
    return jnp.where(inside, jnp.where(jnp.isnan(mean), nearest, 1 / mean), 0)


def row_major(x: Float[Array, " n"], y: Float[Array, " n"], width: int) -> Int[Array, " n"]:
    """Returns the numbers of the pixels at coordinates, row by row."""
    return y.astype(jnp.int32) * width + x.astype(jnp.int32)
