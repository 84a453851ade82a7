"""Portable rasterizer: plain JAX with a hand-written gradient.

sorting.py    stable orders from sorts of words
binning.py    splats -> lists of splats by tile, in rounds of bounded size
tiles.py      the loop over tiles and lists
responses.py  the opacity of a splat at pixels: ellipses; slanted.py: splats that are drawn along rays
blending.py   the blend of a chunk of splats, forward and backward

The forward pass stores no intermediate blends: the backward pass goes over the tiles again, starting from
the final sums.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from splatax.backends.linear import Dims, linear_call
from splatax.backends.portable import blending
from splatax.backends.portable.binning import Boxes, Cursor, Grid, Round, bin_round, slabs_of, tile_boxes
from splatax.backends.portable.responses import Ellipses, Response
from splatax.backends.portable.slanted import Slanted
from splatax.backends.portable.tiles import PIXELS, X, Y, corners, to_image, to_tiles, visit
from splatax.splats import Splats
from splatax.varying import vary_over, varying_axes


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
        splats, channels = residuals.splats, residuals.channels

        def image(*moving):
            return forward(*moved(splats, moving))[0]

        count = arguments_of(splats)
        return jax.jvp(image, directions(splats, channels)[:count], tangents[:count])[1]

    def transpose(self, residuals: Residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of what the image depends on, and of `pull`."""
        return directions(*backward(residuals, cotangents))

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> None:
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


def table_of(splats: Splats, channels: Float[Array, "n c"], boxes: Boxes) -> Float[Array, "rows t"]:
    """Returns shape, opacity and channels of the splats, a row per splat in depth order.

    An additional channel of ones yields alpha. An additional last row draws nothing.
    """
    shape = response_of(splats).columns(splats)
    columns = [*shape, channels, jnp.ones_like(splats.opacities[:, None])]
    return jnp.pad(jnp.concatenate(columns, axis=1)[boxes.order], ((0, 1), (0, 0)))


def response_of(splats: Splats) -> Response:
    """Returns how splats respond at pixels."""
    return Ellipses() if splats.slants is None else Slanted()


def inside(grid: Grid, dtype) -> Float[Array, "tiles p"]:
    """Returns the initial transmittance: 1 inside the image, 0 outside."""
    corner = corners(jnp.arange(grid.tiles), grid, dtype)
    x, y = corner[:, :1] + jnp.asarray(X, dtype)[None], corner[:, 1:] + jnp.asarray(Y, dtype)[None]
    return ((x < grid.width) & (y < grid.height)).astype(dtype)


def at_start(cursor: Cursor) -> Bool[Array, ""]:
    """Returns whether the next round is the first."""
    return (cursor.slab == 0) & (cursor.slot == 0)


def for_each_round(
    next_round: Callable[[Cursor], Round],
    body: Callable[[Cursor, Round, Any], Any],
    carry: Any,
    boxes: Boxes,
    grid: Grid,
) -> Any:
    """Folds body(cursor, round, carry) over all rounds, nearest splats first."""
    slabs, _ = slabs_of(boxes.order.shape[0], grid)

    def step(walk):
        cursor, carry = walk
        round = next_round(cursor)
        return round.following, body(cursor, round, carry)

    start = vary_over(varying_axes(boxes, carry), (Cursor.start(), carry))
    return lax.while_loop(lambda walk: walk[0].slab < slabs, step, start)[1]
