"""The splats that decide each pixel; see `splatax.backends.reference.select` for what it computes."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from splatax.backends.portable import blending
from splatax.backends.portable.binning import Cursor, Grid, Round, bin_round, tile_boxes
from splatax.backends.portable.responses import Response
from splatax.backends.portable.rounds import for_each_round, inside, response_of, table_of
from splatax.backends.portable.tiles import PIXELS, Chunk, to_image, visit
from splatax.backends.protocol import Selection
from splatax.splats import Splats

NONE = -1
# Of a batch of tiles: transmittance [b p], weights and ranks [b p k], median rank [b p].
State = tuple[Array, Array, Array, Array]


def select(splats: Splats, count: int) -> Selection:
    """Finds the splats that contribute most to each pixel."""
    grid = Grid(splats.width, splats.height)
    boxes = tile_boxes(splats, grid)
    table = table_of(splats, splats.colors[:, :0], boxes)

    kept = max(count, 1)  # arrays without elements cannot be cut into tiles
    add = partial(add_chunk, response=response_of(splats), count=kept)

    def walk(_: Cursor, round: Round, state: State) -> State:
        return visit(round.lists, table, grid, add, state, None)[0]

    ranked = (grid.tiles, PIXELS, kept)
    state = (
        inside(grid, table.dtype),
        jnp.zeros(ranked, table.dtype),
        jnp.full(ranked, NONE, jnp.int32),
        jnp.full(ranked[:2], NONE, jnp.int32),
    )
    next_round = partial(bin_round, boxes=boxes, grid=grid)
    _, weights, ranks, median = for_each_round(next_round, walk, state, boxes, grid)

    def rows(ranks: Int[Array, "tiles p c"]) -> Int[Array, "h w c"]:
        found = jnp.where(ranks >= 0, boxes.order[jnp.maximum(ranks, 0)], NONE)
        return to_image(found.swapaxes(1, 2), grid)

    weights = to_image(weights.swapaxes(1, 2), grid)
    return Selection(rows(ranks)[..., :count], weights[..., :count], rows(median[..., None])[..., 0])


def add_chunk(state: State, shared: None, chunk: Chunk, response: Response, count: int) -> tuple[State, None]:
    """Adds a chunk of splats to the selection of a batch of tiles."""
    transmittance, weights, ranks, median = state
    alphas = lax.optimization_barrier(blending.clamp(response.raw_alphas(chunk)))
    before, _ = blending.running(jnp.multiply, 1 - alphas, transmittance)
    own, transmittance = blending.blend_weights(alphas, transmittance)
    own_ranks = jnp.broadcast_to(chunk.ranks[..., None], own.shape)
    halves = (own > 0) & (before > 0.5) & (before * (1 - alphas) <= 0.5)
    median = jnp.maximum(median, jnp.max(jnp.where(halves, own_ranks, NONE), axis=1))
    weights, ranks = largest(
        jnp.concatenate([weights, own.swapaxes(1, 2)], axis=2),
        jnp.concatenate([ranks, own_ranks.swapaxes(1, 2)], axis=2),
        count,
    )
    return (transmittance, weights, ranks, median), shared


def largest(weights: Array, ranks: Array, count: int) -> tuple[Array, Array]:
    """Returns the largest weights along the last axis and their ranks; the first ones among equals."""
    weights, places = jax.lax.top_k(weights, count)
    return weights, jnp.where(weights > 0, jnp.take_along_axis(ranks, places, axis=-1), NONE)
