"""Portable rasterizer: plain JAX with a hand-written gradient.

sorting.py    stable orders from sorts of words
binning.py    splats -> lists of splats by tile, in rounds of bounded size
tiles.py      the loop over tiles and lists
rounds.py     the loop over rounds
responses.py  the opacity of a splat at pixels: ellipses; slanted.py: splats that are drawn along rays
blending.py   the blend of a chunk of splats, forward and backward

The forward pass stores no intermediate blends: the backward pass goes over the tiles again, starting from
the final sums.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from splatax.backends.linear import Batched, linear_call
from splatax.backends.portable import blending
from splatax.backends.portable.binning import Boxes, Cursor, Grid, Round, bin_round, tile_boxes
from splatax.backends.portable.rounds import at_start, for_each_round, inside, response_of, table_of
from splatax.backends.portable.tiles import PIXELS, to_image, to_tiles, visit
from splatax.splats import Splats


class Residuals(NamedTuple):
    """Residuals that the forward pass leaves for the backward pass."""

    splats: Splats
    channels: Float[Array, "n c"]
    sums: Float[Array, "h w c+1"]
    boxes: Boxes
    first: Round  # usually the only one


@jax.custom_jvp
def composite(
    splats: Splats, channels: Float[Array, "n c"]
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends `channels` of the splats, nearest first, into every pixel; see `splatax.composite`."""
    return forward(splats, channels)[0]


@jax.custom_jvp
def drawn(splats: Splats, channels: Float[Array, "n c"]):
    """Returns what `forward` returns. It can be differentiated again, in both modes."""
    return forward(splats, channels)


@drawn.defjvp
def _(primals, tangents):
    image, residuals = drawn(*primals)
    moved = linear_call(DERIVATIVE, residuals, directions(*tangents), image)
    still = jax.tree.map(_no_tangent, residuals)
    sums = jnp.concatenate([moved[0], moved[1][..., None]], axis=-1)
    return (image, residuals), (moved, still._replace(splats=tangents[0], channels=tangents[1], sums=sums))


def _no_tangent(leaf: Array) -> Array | np.ndarray:
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)


def forward(splats: Splats, channels: Float[Array, "n c"]):
    """Returns the image, and the residuals of its gradient."""
    grid = Grid(splats.width, splats.height)
    boxes = tile_boxes(splats, grid)
    response = response_of(splats)
    table = table_of(splats, channels, boxes)
    blend_chunk = partial(blending.blend, response=response)
    next_round = partial(bin_round, boxes=boxes, grid=grid)

    def blend(cursor: Cursor, round: Round, carry):
        state, first = carry
        state, _ = visit(round.lists, table, grid, blend_chunk, state, None)
        return state, jax.tree.map(partial(jnp.where, at_start(cursor)), round, first)

    sums = jnp.zeros((grid.tiles, table.shape[1] - response.COLUMNS, PIXELS), table.dtype)
    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(next_round, Cursor.start())
    )
    (_, sums), first = for_each_round(
        next_round, blend, ((inside(grid, table.dtype), sums), nothing), boxes, grid
    )
    sums = to_image(sums, grid)
    return (sums[..., :-1], sums[..., -1]), Residuals(splats, channels, sums, boxes, first)


def backward(residuals: Residuals, cotangents) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns the gradients of all splats, from those of the image."""
    splats, channels, sums, boxes, first = residuals
    grid, response = Grid(splats.width, splats.height), response_of(splats)
    table = table_of(splats, channels, boxes)
    d_sums = jnp.concatenate([cotangents[0], cotangents[1][..., None]], axis=-1)
    behind = to_tiles(jnp.sum(sums * d_sums, axis=-1, keepdims=True), grid)[:, 0]

    def next_round(cursor: Cursor) -> Round:
        return lax.cond(at_start(cursor), lambda: first, lambda: bin_round(cursor, boxes, grid))

    watched = splats.pull is not None
    blend_gradient = partial(blending.blend_gradient, response=response, watched=watched)
    width = response.SUMS + table.shape[1] - response.COLUMNS  # before those of `pull`

    def add_gradients(_, round: Round, carry):
        return visit(round.lists, table, grid, blend_gradient, *carry)

    state = (inside(grid, table.dtype), behind, to_tiles(d_sums, grid))
    nothing = jnp.zeros((table.shape[0], width + 2 * watched), table.dtype)
    _, gradients = for_each_round(next_round, add_gradients, (state, nothing), boxes, grid)
    gradients = jnp.zeros_like(gradients[:-1]).at[boxes.order].set(gradients[:-1], unique_indices=True)
    shape, d_channels, pull = jnp.split(gradients, [response.SUMS, width], axis=1)
    return response.gradients_of(splats, shape, pull if watched else None), d_channels[:, :-1]


@composite.defjvp
def _(primals, tangents):
    image, residuals = drawn(*primals)
    return image, linear_call(DERIVATIVE, residuals, directions(*tangents), image)


def directions(splats: Splats, channels: Float[Array, "n c"]) -> tuple[Array, ...]:
    """Returns the tangents that the image depends on, and that of `pull`."""
    moving = (splats.means2d, splats.sqrt_conics, splats.opacities, channels)
    more = tuple(leaf for leaf in (splats.slants, splats.pull) if leaf is not None)
    return moving + more


def moved(splats: Splats, moving: tuple[Array, ...]) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns splats and channels from the numbers that the image depends on: those of `directions`."""
    means2d, sqrt_conics, opacities, channels, *slants = moving[: arguments_of(splats)]
    splats = replace(splats, means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities)
    return (replace(splats, slants=slants[0]) if slants else splats), channels


def arguments_of(splats: Splats) -> int:
    """Returns the number of arrays that the image depends on: those of `directions`, but for `pull`."""
    return 4 if splats.slants is None else 5


@dataclass(frozen=True)
class Derivative:
    """The derivative of `composite`: forward by JAX, backward by hand."""

    def apply(self, residuals: Residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the image. `pull` does not affect the image."""
        return pushed(residuals.splats, residuals.channels, tangents)

    def transpose(self, residuals: Residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of what the image depends on, and of `pull`."""
        return directions(*gradient(residuals, cotangents))

    def batched(self, each: Batched) -> None:
        """Returns None: the map of a batch is made by `jax.vmap`."""

    def curvature(
        self, residuals: Residuals, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]
    ) -> Residuals:
        """Returns the gradient in the splats and channels; see `curvature_of_blend`."""
        d_splats, d_channels = curvature_of_blend(residuals.splats, residuals.channels, tangents, cotangents)
        nothing = jax.tree.map(jnp.zeros_like, residuals)
        return nothing._replace(splats=d_splats, channels=d_channels)


DERIVATIVE = Derivative()


def curvature_of_blend(
    splats: Splats, channels: Float[Array, "n c"], tangents: tuple[Array, ...], cotangents: tuple[Array, ...]
) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns the gradient of the sum of cotangents times the image's tangents.

    Second derivatives are symmetric: it is the tangent of the gradient that `cotangents` have, when splats
    and channels move along `tangents`. So the loops over tiles need not be transposed.
    """

    def gradient(*point: Array) -> tuple[Array, ...]:
        d_splats, d_channels = backward(forward(*moved(replace(splats, pull=None), point))[1], cotangents)
        return directions(d_splats, d_channels)[:count]

    count = arguments_of(splats)
    changes = jax.jvp(gradient, directions(splats, channels)[:count], tuple(tangents[:count]))[1]
    return moved(jax.tree.map(jnp.zeros_like, splats), changes)


def pushed(splats: Splats, channels: Float[Array, "n c"], tangents: tuple[Array, ...]) -> tuple[Array, ...]:
    """Returns the tangents of the image, for tangents of `directions`."""

    def image(*moving: Array) -> tuple[Array, ...]:
        return forward(*moved(splats, moving))[0]

    count = arguments_of(splats)
    return jax.jvp(image, directions(splats, channels)[:count], tuple(tangents[:count]))[1]


@jax.custom_jvp
def gradient(residuals: Residuals, cotangents) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns what `backward` returns. It can be differentiated again, in both modes."""
    return backward(residuals, cotangents)


@gradient.defjvp
def _(primals, tangents):
    (residuals, cotangents), (d_residuals, d_cotangents) = primals, tangents
    splats, channels = residuals.splats, residuals.channels
    change = change_of_gradient(
        (splats, channels, cotangents), (d_residuals.splats, d_residuals.channels, d_cotangents)
    )
    return gradient(residuals, cotangents), change


def change_of_gradient(point, tangents) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns the tangents of the gradients of splats and channels.

    Args:
        point: splats, channels, and the cotangents of the image.
        tangents: theirs.
    """
    splats, channels, cotangents = point
    d_splats, d_channels, d_cotangents = tangents
    count = arguments_of(splats)
    along = (*directions(d_splats, d_channels)[:count], *d_cotangents)
    found = linear_call(CHANGE, (splats, channels, tuple(cotangents)), along, directions(splats, channels))
    nothing = jax.tree.map(jnp.zeros_like, splats)
    changed, d_gradient = moved(nothing, found[:count])
    return replace(changed, pull=None if splats.pull is None else found[count]), d_gradient


@dataclass(frozen=True)
class ChangeOfGradient:
    """The derivative of the gradient J^T v, with the Jacobian J of the image and its cotangents v.

    It is H d + J^T e for tangents d of the splats and e of the cotangents. The Hessian H of <v, image> is
    symmetric, so the transpose takes w to H w and J w, which forward mode gives too: no loop is transposed.
    """

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the gradients."""
        splats, channels, cotangents = residuals
        count = arguments_of(splats)

        def gradients(moving: tuple[Array, ...], cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
            return directions(*backward(forward(*moved(splats, moving))[1], cotangents))

        point = directions(splats, channels)[:count], cotangents
        return jax.jvp(gradients, point, (tuple(tangents[:count]), tuple(tangents[count:])))[1]

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the cotangents of splats, channels, and cotangents of the image.

        Raises:
            ValueError: if the splats have a `pull`, which has no second derivative.
        """
        splats, channels, of_image = residuals
        if splats.pull is not None:
            raise ValueError("the gradient of `pull` cannot be differentiated: set `pull` to None")
        d_splats, d_channels = curvature_of_blend(splats, channels, cotangents, of_image)
        return (*directions(d_splats, d_channels), *pushed(splats, channels, cotangents))

    def batched(self, each: Batched) -> None:
        """Returns None: the map of a batch is made by `jax.vmap`."""


CHANGE = ChangeOfGradient()
