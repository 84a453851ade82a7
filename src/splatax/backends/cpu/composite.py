"""The native rasterizer and its gradient; see `splatax.backends.reference` for what it computes."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends import portable
from splatax.backends.cpu import drawing, slanted
from splatax.backends.cpu.library import Build
from splatax.backends.linear import Batched, OfBatch
from splatax.backends.portable.composite import DERIVATIVE, directions, forward
from splatax.backends.protocol import Selection
from splatax.backends.splat_kernels import (
    curvature,
    gradient_shapes,
    gradients_of,
    inputs_of,
    second_derivative,
)
from splatax.splats import Splats

MAX_PULLED_CHANNELS = 16  # NARROW_WALK in native/: with more, no pixel's whole gradient is ever known
MAX_PAIRS = 2**22  # (splat, tile) pairs in a round: at most 260 MB, however large the scene


def composite(
    splats: Splats, channels: Float[Array, "n c"], build: Build, max_pairs: int
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends `channels` of the splats, nearest first, into every pixel; see `splatax.composite`.

    Raises:
        ValueError: if `pull` is asked for with more channels than the kernel blends together.
    """
    if splats.slants is not None:
        return slanted.composite(splats, channels, build, max_pairs)
    if splats.pull is not None and channels.shape[1] > MAX_PULLED_CHANNELS:
        raise ValueError(
            f"the native rasterizer gives the gradient of `pull` for up to {MAX_PULLED_CHANNELS} "
            f"channels, not for {channels.shape[1]}: draw the others apart, or choose the backend 'xla'"
        )
    return drawing.image(splats, channels, Walk(build, max_pairs))


@dataclass(frozen=True)
class Walk:
    """The native `composite` and its derivative; see `drawing.Walk`.

    Attributes:
        build, max_pairs: see `composite`.
    """

    build: Build
    max_pairs: int

    def draw(
        self, splats: Splats, channels: Float[Array, "n c"], gradient_follows: bool
    ) -> tuple[Array, Array, Array]:
        """Returns sums, alpha, and a ticket with which the gradient finds the lists of tiles again."""
        size = (splats.height, splats.width)
        ticket_type = jax.ShapeDtypeStruct((), jnp.int32)
        sums, alpha, ticket = self.build.call(
            "splatax_rasterize_forward",
            [(*size, channels.shape[1]), size, ticket_type],
            inputs_of(splats, channels),
            batches=True,
            max_pairs=np.int64(self.max_pairs),
            gradient_follows=np.int64(gradient_follows),
        )
        return sums, alpha, ticket

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the image."""
        splats, channels, *_ = residuals
        one = tuple(tangent[None] for tangent in tangents[:4])
        return tuple(image[..., 0] for image in _push((splats, channels), one, self.build, self.max_pairs))

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of what the image depends on, and of `pull`."""
        return directions(*_pull_back(residuals, cotangents, self.build, self.max_pairs))

    def batched(self, each: Batched) -> OfBatch | None:
        """Returns the map of several directions at the same splats. Native calls take other batches."""
        if any(dim is not None for dim in each.residuals):
            return None
        return OfBatch(ManyDirections(self, each), axis=-1)

    def curvature(self, residuals, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]):
        """Returns the gradient in the splats and channels, by the portable kernel."""
        return curvature(residuals, tangents, cotangents)


@dataclass(frozen=True)
class ManyDirections:
    """The derivative of one image along several directions, which are the last axis of what it returns.

    It is the axis that `jax.jacfwd` returns, so no image is transposed.

    Attributes:
        walk: of the image.
        each: the same derivative, direction by direction.
    """

    walk: Walk
    each: Batched

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the image along all directions."""
        splats, channels, *_ = residuals
        dims = self.each.tangents
        count = next(len(tangent) for tangent, dim in zip(tangents, dims, strict=True) if dim is not None)
        whole = tuple(
            jnp.broadcast_to(tangent, (count, *tangent.shape)) if dim is None else tangent
            for tangent, dim in zip(tangents[:4], dims[:4], strict=True)
        )
        return _push((splats, channels), whole, self.walk.build, self.walk.max_pairs)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of each direction, and sums those of what the directions share."""
        return self.each.transpose(residuals, _first(cotangents))

    def batched(self, each: Batched) -> None:
        """Returns None: native calls take batches."""

    def curvature(self, residuals, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]):
        """Returns the gradient in the splats and channels, summed over the directions."""
        return self.each.curvature(residuals, tangents, _first(cotangents))


def _first(images: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(jnp.moveaxis(image, -1, 0) for image in images)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _push(point, tangents: tuple[Array, ...], build: Build, max_pairs: int) -> tuple[Array, ...]:
    """Returns tangents of the image. Directions are the first axis of `tangents`, and the last one here."""
    splats, channels = point
    size, count = (splats.height, splats.width), len(tangents[0])
    return tuple(
        build.call(
            "splatax_rasterize_tangent",
            [(*size, channels.shape[1], count), (*size, count)],
            [*inputs_of(splats, channels), *tangents],
            batches=True,
            max_pairs=np.int64(max_pairs),
        )
    )


@_push.defjvp
def _(build: Build, max_pairs: int, primals, tangents):
    # Second derivatives come from the portable kernel, which JAX differentiates.
    def push(point, tangents):
        along = partial(DERIVATIVE.apply, forward(*point)[1])
        return jax.vmap(along, out_axes=-1)(tangents)

    return _push(*primals, build, max_pairs), jax.jvp(push, primals, tangents)[1]


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _pull_back(residuals, cotangents, build: Build, max_pairs: int):
    splats, channels, *image = residuals
    arrays = build.call(
        "splatax_rasterize_backward",
        gradient_shapes(splats, channels),
        [*inputs_of(splats, channels), *image, *cotangents],
        batches=True,
        max_pairs=np.int64(max_pairs),
    )
    return gradients_of(splats, arrays)


@_pull_back.defjvp
def _(build: Build, max_pairs: int, primals, tangents):
    return _pull_back(*primals, build, max_pairs), second_derivative(primals, tangents)


def select(splats: Splats, count: int, build: Build, max_pairs: int) -> Selection:
    """Finds the splats that contribute most to each pixel; see `splatax.backends.reference.select`.

    For splats with slants, the portable kernel does.
    """
    if splats.slants is not None:
        return portable.select(splats, count)
    size = (splats.height, splats.width)
    indices, weights, median = build.call(
        "splatax_select",
        [
            jax.ShapeDtypeStruct((*size, count), jnp.int32),
            (*size, count),
            jax.ShapeDtypeStruct(size, jnp.int32),
        ],
        inputs_of(splats, splats.colors),
        batches=True,
        max_pairs=np.int64(max_pairs),
    )
    return Selection(indices, weights, median)
