"""Splatting as the paper defines it, pixel by pixel: the reference that every backend is tested against.

    C = sum_i T_i alpha_i c_i,   T_i = prod_{j<i} (1 - alpha_j)         (Kerbl et al. 2023, Eq. 3)

Splats are sorted by depth once; every pixel looks at every splat. JAX differentiates it. Time
grows with pixels times splats, so it is for reading and testing, not for training.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax import along_rays, losses, moving, projection, surfaces
from splatax.backends.linear import Batched, linear_call
from splatax.backends.protocol import Kernels, Selection
from splatax.splats import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, Splats


def composite(
    splats: Splats, channels: Float[Array, "n c"]
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends `channels` of the splats, nearest first, into every pixel; see `splatax.composite`."""
    visible = jnp.all(splats.extents > 0, axis=1)
    order = jnp.argsort(jnp.where(visible, splats.depths, jnp.inf), stable=True)
    means2d, sqrt_conics = splats.means2d[order], splats.sqrt_conics[order]
    opacities = jnp.where(visible, splats.opacities, 0)[order]
    channels = channels[order]
    pull = None if splats.pull is None else splats.pull[order]
    slants = None if splats.slants is None else splats.slants[order]

    def pixel(x: Float[Array, ""], y: Float[Array, ""]):
        alphas = alphas_at(offsets(jnp.array([x, y]), means2d, pull), sqrt_conics, opacities, slants)
        weights = weights_along_ray(alphas)
        return weights @ channels, jnp.sum(weights)

    columns = jnp.arange(splats.width, dtype=means2d.dtype) + 0.5
    rows = jnp.arange(splats.height, dtype=means2d.dtype) + 0.5
    # Rows are recomputed in the backward pass, so memory holds one row instead of the image.
    row = jax.checkpoint(jax.vmap(pixel, in_axes=(0, None)))
    return jax.lax.map(lambda y: row(columns, y), rows)


def select(splats: Splats, count: int) -> Selection:
    """Finds the splats that contribute most to each pixel, and the one that makes it half opaque.

    Args:
        splats: at least one.
        count: how many splats to find for each pixel.
    """
    n = splats.means2d.shape[0]
    visible = jnp.all(splats.extents > 0, axis=1)
    order = jnp.argsort(jnp.where(visible, splats.depths, jnp.inf), stable=True).astype(jnp.int32)
    means2d, sqrt_conics = splats.means2d[order], splats.sqrt_conics[order]
    opacities = jnp.where(visible, splats.opacities, 0)[order]
    slants = None if splats.slants is None else splats.slants[order]

    def pixel(x: Float[Array, ""], y: Float[Array, ""]) -> Selection:
        alphas = alphas_at(offsets(jnp.array([x, y]), means2d, None), sqrt_conics, opacities, slants)
        weights = weights_along_ray(alphas)
        largest, places = jax.lax.top_k(jnp.pad(weights, (0, count)), count)
        indices = jnp.where(largest > 0, order[jnp.minimum(places, n - 1)], -1)
        drawn = jnp.cumprod(jnp.where(weights > 0, 1 - alphas, 1))
        median = jnp.where(drawn[-1] <= 0.5, order[jnp.argmax(drawn <= 0.5)], -1)
        return Selection(indices, largest, median)

    columns = jnp.arange(splats.width, dtype=means2d.dtype) + 0.5
    rows = jnp.arange(splats.height, dtype=means2d.dtype) + 0.5
    return jax.lax.map(lambda y: jax.vmap(pixel, in_axes=(0, None))(columns, y), rows)


def offsets(
    pixel: Float[Array, "2"], means2d: Float[Array, "n 2"], pull: Float[Array, "n 2"] | None
) -> Float[Array, "n 2"]:
    """Returns the offsets from the means to a pixel."""
    return pixel[None, :] - means2d if pull is None else watched_offsets(pixel, means2d, pull)


@jax.custom_jvp
def watched_offsets(
    pixel: Float[Array, "2"], means2d: Float[Array, "n 2"], pull: Float[Array, "n 2"]
) -> Float[Array, "n 2"]:
    """Returns the offsets; `pull` gets the absolute value of the pixel's part of the means' gradient."""
    return pixel[None, :] - means2d


@watched_offsets.defjvp
def _(primals, tangents):
    found = watched_offsets(*primals)
    return found, linear_call(WATCHED, (), tangents, (found,))[0]


@dataclass(frozen=True)
class Watched:
    """The derivative of `watched_offsets`."""

    def apply(self, residuals: tuple[()], tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangent of the offsets; `pull` does not affect them."""
        pixel, means2d, _ = tangents
        return (pixel[None, :] - means2d,)

    def transpose(self, residuals: tuple[()], cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of pixel and means, and for `pull` the absolute value of the latter."""
        (gradient,) = cotangents
        return jnp.sum(gradient, axis=0), -gradient, jnp.abs(gradient)

    def batched(self, each: Batched) -> None:
        """Returns None: the map of a batch is made by `jax.vmap`."""


WATCHED = Watched()


def alphas_at(
    offsets: Float[Array, "n 2"],
    sqrt_conics: Float[Array, "n 3"],
    opacities: Float[Array, " n"],
    slants: Float[Array, "n 6"] | None = None,
) -> Float[Array, " n"]:
    """Returns alpha = min(0.99, opacity G) at offsets from the means, or 0 if that is below 1/255."""
    dx, dy = offsets.T
    u, v, w = sqrt_conics.T
    if slants is None:
        squared = jnp.square(u * dx + v * dy) + jnp.square(w * dy)
    else:
        squared = along_rays.squared_distances(offsets, sqrt_conics, slants)
    gaussian = jnp.exp(-0.5 * squared)
    alphas = jnp.minimum(opacities * gaussian, MAX_ALPHA)
    return jnp.where(alphas >= MIN_ALPHA, alphas, 0)


def weights_along_ray(alphas: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns T_i alpha_i from near to far, and 0 from the splat that would take T below 1e-4."""
    after = jnp.cumprod(1 - alphas)
    before = jnp.concatenate([jnp.ones_like(after[:1]), after[:-1]])
    return jnp.where(after >= MIN_TRANSMITTANCE, before * alphas, 0)


KERNELS = Kernels(
    "reference",
    projection.project,
    composite,
    select,
    losses.photometric,
    moving.move,
    surfaces.planes,
)
