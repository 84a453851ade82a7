"""Loops over the lists of all tiles, many tiles and several splats at a time.

Tiles are processed in batches of similar list length, and lists in chunks, so that a visitor works on
arrays [tile, splat, pixel] that are large enough for XLA to vectorize and split over cores.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

from splatax.backends.portable.binning import TILE, Grid, Lists
from splatax.backends.portable.sorting import stable_order

PIXELS = TILE * TILE
X = np.tile(np.arange(TILE) + 0.5, TILE)  # x of a tile's pixel centres, relative to its corner
Y = np.repeat(np.arange(TILE) + 0.5, TILE)
CHUNK = 32  # splats of a list that are processed together
BATCH = {"cpu": 64}  # tiles processed together: fits a core's cache; on other platforms, fills a device
LARGE_BATCH = 4096


class Chunk(NamedTuple):
    """Next splats in the lists of a batch of tiles."""

    ranks: Int[Array, "b k"]  # rows of the table; past the end of a list, its empty last row
    rows: Float[Array, "b k t"]  # (mean x, y, u, v, w, opacity, channels ...)
    corner: Float[Array, "b 2"]  # top left corner of the tiles, pixels


# A visitor takes the state of a batch of tiles (a tuple whose first entry is transmittance, 0 where a pixel
# is finished), an accumulator that all tiles share, and a chunk. It returns the new state and accumulator.
Visitor = Callable[[Any, Any, Chunk], tuple[Any, Any]]


def to_tiles(image: Float[Array, "h w c"], grid: Grid) -> Float[Array, "tiles c p"]:
    """Cuts an image into tiles, pixels last; pixels outside the image are zero."""
    rows, columns = grid.rows, grid.columns
    image = jnp.pad(image, ((0, rows * TILE - grid.height), (0, columns * TILE - grid.width), (0, 0)))
    tiles = image.reshape(rows, TILE, columns, TILE, -1).transpose(0, 2, 4, 1, 3)
    return tiles.reshape(grid.tiles, -1, PIXELS)


def to_image(tiles: Num[Array, "tiles c p"], grid: Grid) -> Num[Array, "h w c"]:
    """Assembles an image from its tiles."""
    image = tiles.reshape(grid.rows, grid.columns, -1, TILE, TILE).transpose(0, 3, 1, 4, 2)
    return image.reshape(grid.rows * TILE, grid.columns * TILE, -1)[: grid.height, : grid.width]


def corners(tiles: Int[Array, "*b"], grid: Grid, dtype) -> Float[Array, "*b 2"]:
    """Returns the pixel coordinates of the top left corners of tiles."""
    return (jnp.stack([tiles % grid.columns, tiles // grid.columns], -1) * TILE).astype(dtype)


def visit(
    lists: Lists, table: Float[Array, "rows t"], grid: Grid, visitor: Visitor, state: Any, shared: Any
) -> tuple[Any, Any]:
    """Calls a visitor with each tile's list, nearest splats first, until all pixels of the tile are finished.

    Args:
        lists: lists of a round.
        table: a row per splat in depth order, and a last row that draws nothing.
        grid: tiles of the image.
        visitor: function that processes a chunk.
        state: arrays [tiles, ...]; the first is transmittance.
        shared: value that the visitor accumulates over all tiles.
    """
    batch = min(BATCH.get(jax.default_backend(), LARGE_BATCH), grid.tiles)
    batches = -(-grid.tiles // batch)
    lengths = jnp.diff(lists.starts)
    order = stable_order((jnp.max(lengths) - lengths).astype(jnp.uint32))
    # Padding tiles past the last one have no splats, and are dropped at the end.
    order = jnp.pad(order, (0, batches * batch - grid.tiles), constant_values=grid.tiles).reshape(
        batches, batch
    )
    lengths, starts = jnp.append(lengths, 0)[order], lists.starts[order]

    def visit_batch(shared, batch):
        tiles, length, start, local = batch
        corner = corners(tiles, grid, table.dtype)

        def visit_chunk(carry):
            done, local, shared = carry
            place = done + jnp.arange(CHUNK, dtype=jnp.int32)[None, :]
            slot = jnp.minimum(start[:, None] + place, lists.ranks.shape[0] - 1)
            ranks = jnp.where(place < length[:, None], lists.ranks[slot], table.shape[0] - 1)
            rows = lax.optimization_barrier(table[ranks])
            local, shared = visitor(local, shared, Chunk(ranks, rows, corner))
            return done + CHUNK, local, shared

        def more(carry):
            done, local, _ = carry
            return (done < length[0]) & jnp.any(local[0] > 0)

        _, local, shared = lax.while_loop(more, visit_chunk, (jnp.int32(0), local, shared))
        return shared, local

    batched = jax.tree.map(lambda array: array[jnp.minimum(order, grid.tiles - 1)], state)
    shared, batched = lax.scan(visit_batch, shared, (order, lengths, starts, batched))

    def put_back(old, new):
        rows = new.reshape(-1, *old.shape[1:])
        return old.at[order.ravel()].set(rows, mode="drop", unique_indices=True)

    return jax.tree.map(put_back, state, batched), shared
