"""The rasterizer on the GPU and its gradient; see `splatax.backends.reference` for what it computes."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends import portable
from splatax.backends.cuda.library import Library
from splatax.backends.foreign import Shape
from splatax.backends.linear import Batched, linear_call
from splatax.backends.portable.composite import DERIVATIVE, directions, forward
from splatax.backends.splat_kernels import (
    curvature,
    gradient_shapes,
    gradients_of,
    inputs_of,
    second_derivative,
)
from splatax.splats import Splats

MAX_PAIRS = 2**22  # (splat, tile) pairs in a round: with the gradient 200 MB at 1080p
MAX_PULLED_CHANNELS = 4  # with more, no kernel ever knows the whole gradient of a pixel
TILE, PIXELS, CHUNK = 16, 256, 128  # as in native/cuda/kernels/arguments.cuh


def composite(
    splats: Splats, channels: Float[Array, "n c"], library: Library, max_pairs: int
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends `channels` of the splats, nearest first, into every pixel; see `splatax.composite`.

    Splats with slants are blended by the portable kernel.

    Raises:
        ValueError: if `pull` is asked for with more channels than the kernel blends together.
    """
    if splats.slants is not None:
        return portable.composite(splats, channels)
    c = channels.shape[1]
    if splats.pull is not None and c > MAX_PULLED_CHANNELS:
        raise ValueError(
            f"the CUDA rasterizer gives the gradient of `pull` for up to {MAX_PULLED_CHANNELS} "
            f"channels, not for {c}: draw the others apart, or choose the backend 'xla'"
        )
    # There are kernels for 1, 3 and 4 channels.
    padding = 1 if c == 0 or c % 4 == 2 else 0
    sums, alpha = _composite(splats, jnp.pad(channels, ((0, 0), (0, padding))), library, max_pairs)
    return sums[..., :c], alpha


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _composite(splats: Splats, channels: Float[Array, "n c"], library: Library, max_pairs: int):
    return _draw(splats, channels, library, max_pairs, words=0, floats=0)[:2]


@_composite.defjvp
def _(library: Library, max_pairs: int, primals, tangents):
    drawn = _drawn(*primals, library, max_pairs)
    return drawn[:2], _derivative(library, max_pairs, primals, drawn, tangents)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _drawn(splats: Splats, channels: Float[Array, "n c"], library: Library, max_pairs: int):
    """Returns the image, and the lists and checkpoints for its gradient."""
    tiles = -(-splats.width // TILE) * -(-splats.height // TILE)
    pairs = max(max_pairs, tiles)
    n, c = channels.shape
    words = 2 * n + 1 + 2 * pairs + 3 * tiles + 2  # as `Sizes` in native/cuda/host/rasterize.h
    floats = (pairs // CHUNK + tiles) * (1 + c) * PIXELS
    return _draw(splats, channels, library, max_pairs, words, floats)


@_drawn.defjvp
def _(library: Library, max_pairs: int, primals, tangents):
    drawn = _drawn(*primals, library, max_pairs)
    *_, words, checkpoints = drawn
    moved = _derivative(library, max_pairs, primals, drawn, tangents)
    # The second derivative recomputes the checkpoints, so their tangent is not used.
    no_tangent = np.zeros(words.shape, jax.dtypes.float0)
    return drawn, (*moved, no_tangent, jnp.zeros_like(checkpoints))


def _derivative(library: Library, max_pairs: int, primals, drawn: tuple[Array, ...], tangents):
    return linear_call(Derivative(library, max_pairs), (*primals, *drawn), directions(*tangents), drawn[:2])


@dataclass(frozen=True)
class Derivative:
    """The derivative of `composite`: backward on the GPU, forward by the portable kernel.

    Attributes:
        library, max_pairs: see `composite`.
    """

    library: Library
    max_pairs: int

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the image."""
        splats, channels, *_ = residuals
        return DERIVATIVE.apply(forward(splats, channels)[1], tangents)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of what the image depends on, and of `pull`."""
        return directions(*_pull_back(residuals, cotangents, self.library, self.max_pairs))

    def batched(self, each: Batched) -> None:
        """Returns None: `jax.vmap` calls the derivative once for each element."""

    def curvature(self, residuals, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]):
        """Returns the gradient in the splats and channels, by the portable kernel."""
        return curvature(residuals, tangents, cotangents)


def _draw(
    splats: Splats, channels: Float[Array, "n c"], library: Library, max_pairs: int, words: int, floats: int
) -> tuple[Array, ...]:
    """Returns sums, alpha, and the lists and checkpoints for the gradient, empty if none follows."""
    size = (splats.height, splats.width)
    shapes: list[Shape] = [
        (*size, channels.shape[1]),
        size,
        jax.ShapeDtypeStruct((words,), jnp.uint32),
        (floats,),
    ]
    inputs = inputs_of(splats, channels)
    return tuple(library.call("splatax_cuda_rasterize", shapes, inputs, max_pairs=np.int64(max_pairs)))


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _pull_back(residuals, cotangents, library: Library, max_pairs: int):
    splats, channels, sums, alpha, words, checkpoints = residuals
    arrays = library.call(
        "splatax_cuda_rasterize_gradient",
        gradient_shapes(splats, channels),
        [*inputs_of(splats, channels), sums, alpha, *cotangents, checkpoints, words],
        max_pairs=np.int64(max_pairs),
    )
    return gradients_of(splats, arrays)


@_pull_back.defjvp
def _(library: Library, max_pairs: int, primals, tangents):
    return _pull_back(*primals, library, max_pairs), second_derivative(primals, tangents)
