"""The native rasterizer of splats that are drawn along rays; see `splatax.along_rays` for what it computes.

The library lists splats by ellipses that hold all pixels in which they are drawn. It returns sums over
pixels, of which the portable response makes gradients. Up to four channels are blended in one walk over the
splats, and more of them twelve at a time.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import along_rays
from splatax.backends.cpu import drawing
from splatax.backends.cpu.library import Build
from splatax.backends.linear import Batched
from splatax.backends.portable.composite import DERIVATIVE, directions, forward
from splatax.backends.portable.slanted import Slanted
from splatax.backends.splat_kernels import curvature, second_derivative
from splatax.splats import MIN_ALPHA, Splats, slants_of

GROUP, WIDE_GROUP = 4, 12  # channels of a walk, as in native/cpu/splats.h and native/cpu/slanted.h
MOMENTS = 14  # SLANTED_MOMENTS in native/cpu/slanted.h
PULL = 2
HALF_LOG2_E = 0.5 * float(np.log2(np.e))  # turns squared distances into powers of two
UNBOUNDED = 1e-9, 0.0, 1e-9  # root of an ellipse that is larger than any image


def composite(
    splats: Splats, channels: Float[Array, "n c"], build: Build, max_pairs: int
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends `channels` of splats with slants, nearest first, into every pixel; see `splatax.composite`.

    Raises:
        ValueError: if `pull` is asked for with more channels than the kernel blends together.
    """
    count = channels.shape[1]
    if splats.pull is not None and count > GROUP:
        raise ValueError(
            "the native rasterizer gives the gradient of `pull` of splats drawn along rays for up to "
            f"{GROUP} channels, not for {count}: draw the others apart, or choose the backend 'xla'"
        )
    parts = [
        drawing.image(splats, channels[:, first : first + WIDE_GROUP], Walk(build, max_pairs))
        for first in range(0, max(count, 1), WIDE_GROUP)
    ]
    return jnp.concatenate([sums for sums, _ in parts], axis=2), parts[0][1]


def _width(channels: Float[Array, "n c"]) -> int:
    """Returns the number of channels of the walk that blends these."""
    return GROUP if channels.shape[1] <= GROUP else WIDE_GROUP


@dataclass(frozen=True)
class Walk:
    """A walk and its derivative: backward by the library, forward by the portable kernel.

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
        sums, alpha, ticket = self.build.call(
            "splatax_slanted_forward",
            [(*size, _width(channels)), size, jax.ShapeDtypeStruct((), jnp.int32)],
            inputs_of(splats, channels),
            max_pairs=np.int64(self.max_pairs),
            gradient_follows=np.int64(gradient_follows),
        )
        return sums[..., : channels.shape[1]], alpha, ticket

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the image."""
        splats, channels, *_ = residuals
        return DERIVATIVE.apply(forward(splats, channels)[1], tangents)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of what the image depends on, and of `pull`."""
        return directions(*_pull_back(residuals, cotangents, self.build, self.max_pairs))

    def batched(self, each: Batched) -> None:
        """Returns None: `jax.vmap` calls the derivative once for each element."""

    def curvature(self, residuals, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]):
        """Returns the gradient in the splats and channels, by the portable kernel."""
        return curvature(residuals, tangents, cotangents)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _pull_back(residuals, cotangents, build: Build, max_pairs: int):
    splats, channels, sums, alpha, ticket = residuals
    d_sums, d_alpha = cotangents
    count, width = channels.shape[1], _width(channels)
    more = ((0, 0), (0, 0), (0, width - count))
    (found,) = build.call(
        "splatax_slanted_backward",
        [(len(splats.depths), MOMENTS + width + PULL)],
        [*inputs_of(splats, channels), jnp.pad(sums, more), alpha, ticket, jnp.pad(d_sums, more), d_alpha],
        max_pairs=np.int64(max_pairs),
        pulled=np.int64(splats.pull is not None),
    )
    total, k, slack, e, d_channels, pulls = jnp.split(found, [1, 6, 12, MOMENTS, MOMENTS + width], axis=1)
    none = jnp.zeros_like(total)  # the moments that no gradient needs
    moments = jnp.concatenate([total, none, k, slack / HALF_LOG2_E, none, e], axis=1)
    pull = None if splats.pull is None else pulls / HALF_LOG2_E
    return Slanted().gradients_of(splats, moments, pull), d_channels[:, :count]


@_pull_back.defjvp
def _(build: Build, max_pairs: int, primals, tangents):
    return _pull_back(*primals, build, max_pairs), second_derivative(primals, tangents)


def inputs_of(splats: Splats, channels: Float[Array, "n c"]) -> list[Array]:
    """Returns the arrays of the kernel: ellipses that hold the splats, and rows of what is drawn in them."""
    slants = slants_of(splats)
    root = HALF_LOG2_E**0.5
    rows = [
        splats.means2d,
        splats.sqrt_conics * root,
        jnp.log2(splats.opacities)[:, None],
        slants[:, :5],
        slants[:, 5:] * HALF_LOG2_E,
        jnp.pad(channels, ((0, 0), (0, _width(channels) - channels.shape[1]))),
    ]
    means2d, sqrt_conics, extents = hulls_of(splats)
    hulls = [means2d, sqrt_conics, splats.depths, extents, splats.opacities]
    return [*hulls, jnp.concatenate(rows, axis=1)]


def hulls_of(
    splats: Splats,
) -> tuple[Float[Array, "n 2"], Float[Array, "n 3"], Float[Array, "n 2"]]:
    """Returns ellipses around all pixels that splats reach, as if they were splats of the same opacity.

    A splat reaches the ellipse of `along_rays.bounds` and a disc of blur around its mean, which lies in a
    larger disc around the centre of that ellipse. The hull has the axes of the ellipse, but none that is
    shorter than the radius of the larger disc, so it contains all of them.

    Returns:
        Centres, roots of inverse covariances, and half widths and heights of their boxes.
    """
    slants = slants_of(splats)
    found = along_rays.bounds(splats.sqrt_conics, slants, splats.opacities)
    squared = jnp.maximum(2 * jnp.log(jnp.maximum(splats.opacities / MIN_ALPHA, 1)), 1e-6)
    bounded = found.reach < along_rays.EVERYWHERE
    u, v, w = found.sqrt_conics.T
    size = jnp.where(bounded, found.reach, 1) / squared
    across = v / (u * w)
    a, b, c = size * (1 / (u * u) + across * across), -size * across / w, size / (w * w)
    apart = jnp.sqrt(jnp.sum(found.offsets * found.offsets, axis=1) / squared)
    blur = along_rays.MARGIN * jnp.square(1 / jnp.sqrt(slants[:, 5]) + apart)
    spread = jnp.sqrt(jnp.square(a - c) + 4 * b * b)  # difference of the squared axes
    longest = (a + c + spread) / 2
    shortest = jnp.square(size / (u * w)) / longest
    # 0 if both axes are longer than the blur, 1 if none is; between, the shorter one becomes as long.
    rounded = jnp.clip((blur - shortest) / jnp.maximum(spread, 1e-30), 0, 1)
    longest, shortest = jnp.maximum(longest, blur), jnp.maximum(shortest, blur)
    a, b, c = ((1 - rounded) * value for value in (a, b, c))
    a, c = a + rounded * longest, c + rounded * longest
    determinant = longest * shortest
    bounded &= determinant > 0
    safe = jnp.where(bounded, determinant, 1)
    rows = jnp.stack([jnp.sqrt(c / safe), -b / jnp.sqrt(c * safe), 1 / jnp.sqrt(c)], axis=1)
    rows = jnp.where(bounded[:, None], rows, jnp.array([UNBOUNDED], rows.dtype))
    shown = jnp.all(splats.extents > 0, axis=1) & (splats.opacities > 0)
    half = jnp.sqrt(squared[:, None] * jnp.stack([a, c], axis=1))
    half = jnp.where(bounded[:, None], half, 1 / UNBOUNDED[0])
    return splats.means2d + found.offsets, rows, jnp.where(shown[:, None], half, 0)
