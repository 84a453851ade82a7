"""The walk over all rounds of a view, nearest splats first, and what it starts from."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from splatax.backends.portable.binning import Boxes, Cursor, Grid, Round, slabs_of
from splatax.backends.portable.responses import Ellipses, Response
from splatax.backends.portable.slanted import Slanted
from splatax.backends.portable.tiles import X, Y, corners
from splatax.splats import Splats
from splatax.varying import vary_over, varying_axes


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
