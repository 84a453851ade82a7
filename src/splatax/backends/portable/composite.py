"""Portable rasterizer: plain JAX with a hand-written gradient.

sorting.py    stable orders from sorts of words
binning.py    splats -> lists of splats by tile, in rounds of bounded size
tiles.py      the loop over tiles and lists
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
    table = table_of(splats, channels, boxes)
    next_round = partial(bin_round, boxes=boxes, grid=grid)

    def blend(cursor: Cursor, round: Round, carry):
        state, first = carry
        state, _ = visit(round.lists, table, grid, blending.blend, state, None)
        return state, jax.tree.map(partial(jnp.where, at_start(cursor)), round, first)

    sums = jnp.zeros((grid.tiles, table.shape[1] - blending.SHAPE, PIXELS), table.dtype)
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
    grid = Grid(splats.width, splats.height)
    table = table_of(splats, channels, boxes)
    d_sums = jnp.concatenate([cotangents[0], cotangents[1][..., None]], axis=-1)
    behind = to_tiles(jnp.sum(sums * d_sums, axis=-1, keepdims=True), grid)[:, 0]

    def next_round(cursor: Cursor) -> Round:
        return lax.cond(at_start(cursor), lambda: first, lambda: bin_round(cursor, boxes, grid))

    watched = splats.pull is not None
    blend_gradient = partial(blending.blend_gradient, watched=watched)

    def add_gradients(_, round: Round, carry):
        return visit(round.lists, table, grid, blend_gradient, *carry)

    state = (inside(grid, table.dtype), behind, to_tiles(d_sums, grid))
    nothing = jnp.zeros((table.shape[0], table.shape[1] + 2 * watched), table.dtype)
    _, gradients = for_each_round(next_round, add_gradients, (state, nothing), boxes, grid)
    gradients = jnp.zeros_like(gradients[:-1]).at[boxes.order].set(gradients[:-1], unique_indices=True)
    moments, d_channels, pull = jnp.split(gradients, [blending.SHAPE, table.shape[1]], axis=1)
    return gradients_of(splats, moments, pull if watched else None), d_channels[:, :-1]


@composite.defjvp
def _(primals, tangents):
    image, residuals = drawn(*primals)
    return image, linear_call(DERIVATIVE, residuals, directions(*tangents), image)


def directions(splats: Splats, channels: Float[Array, "n c"]) -> tuple[Array, ...]:
    """Returns the tangents that the image depends on."""
    moving = (splats.means2d, splats.sqrt_conics, splats.opacities, channels)
    return moving if splats.pull is None else (*moving, splats.pull)


@dataclass(frozen=True)
class Derivative:
    """The derivative of `composite`: forward by JAX, backward by hand."""

    def apply(self, residuals: Residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the image. `pull` does not affect the image."""
        splats, channels = residuals.splats, residuals.channels

        def image(means2d, sqrt_conics, opacities, channels):
            moved = replace(splats, means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities)
            return forward(moved, channels)[0]

        return jax.jvp(image, directions(splats, channels)[:4], tangents[:4])[1]

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

    def gradient(*point: Array) -> tuple[Splats, Float[Array, "n c"]]:
        means2d, sqrt_conics, opacities, channels = point
        moved = replace(splats, means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities, pull=None)
        return backward(forward(moved, channels)[1], cotangents)

    d_splats, d_channels = jax.jvp(gradient, directions(splats, channels)[:4], tuple(tangents[:4]))[1]
    nothing = jax.tree.map(jnp.zeros_like, splats)
    moving = {name: getattr(d_splats, name) for name in ("means2d", "sqrt_conics", "opacities")}
    return replace(nothing, **moving), d_channels


def table_of(splats: Splats, channels: Float[Array, "n c"], boxes: Boxes) -> Float[Array, "rows t"]:
    """Returns shape, opacity and channels of the splats, a row per splat in depth order.

    An additional channel of ones yields alpha. An additional last row draws nothing.
    """
    columns = [
        splats.means2d,
        splats.sqrt_conics,
        splats.opacities[:, None],
        channels,
        jnp.ones_like(splats.opacities[:, None]),
    ]
    return jnp.pad(jnp.concatenate(columns, axis=1)[boxes.order], ((0, 1), (0, 0)))


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


def gradients_of(splats: Splats, moments: Float[Array, "n 6"], pull: Float[Array, "n 2"] | None) -> Splats:
    """Turns moments of g = alpha dL/d alpha about each mean into gradients of its splat.

    With alpha = o exp(-(s^2 + t^2) / 2), s = u dx + v dy, t = w dy and d = pixel - mean:

        dL/d mean = sum g (s (u, v) + t (0, w)),   dL/d(u, v, w) = -sum g (s dx, s dy, t dy).
    """
    g, gx, gy, gxx, gxy, gyy = moments.T
    u, v, w = splats.sqrt_conics.T
    along = u * gx + v * gy
    opacities = splats.opacities
    return replace(
        splats,
        means2d=jnp.stack([u * along, v * along + w * w * gy], axis=1),
        sqrt_conics=-jnp.stack([u * gxx + v * gxy, u * gxy + v * gyy, w * gyy], axis=1),
        depths=jnp.zeros_like(splats.depths),
        extents=jnp.zeros_like(splats.extents),
        colors=jnp.zeros_like(splats.colors),
        opacities=jnp.where(opacities > 0, g / jnp.where(opacities > 0, opacities, 1), 0),
        pull=pull,
    )
