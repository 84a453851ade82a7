"""Lists the splats that touch each tile, in rounds of bounded size, so that no list is ever truncated.

Splats are sorted by depth once. The tiles in the boxes of all splats, in this order, form a long sequence
of slots, one per (splat, tile). A round takes the next `capacity` slots and sorts them by tile. Blending
goes front to back and carries its state from round to round. The image is therefore exact for any number
of slots, and memory does not grow with that number.

    splat (by depth)   0      1          2   3
    slots              t0 t1  t0 t1 t2   t1  t2 t3        <- sorted by tile: lists of one round
                       |--- round 0 ---| |- round 1 -|
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatax import along_rays
from splatax.backends.portable.sorting import bits_for, depth_order, stable_order
from splatax.splats import MIN_ALPHA, Splats, slants_of

TILE = 8  # pixels per side; 16 would have fewer slots, but 2.4 times the pixels to evaluate
SLOTS_PER_TILE = 64  # slots of a full round per tile, enough to fill the chunks that blending uses
SLOTS_PER_SPLAT = 2
CAPACITY_BITS = (12, 22)  # log2 of the least and most slots in a round; 2^22 take about 200 MB
MAX_SLOTS = 2**31 - 1  # slots of a slab, counted in int32


class Grid(NamedTuple):
    """Tiles of an image, row by row; the last row and column may extend beyond the image."""

    width: int
    height: int

    @property
    def columns(self) -> int:
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE)

    @property
    def tiles(self) -> int:
        return self.columns * self.rows


class Boxes(NamedTuple):
    """Splats in depth order, and the rectangle of tiles that each may touch."""

    order: Int[Array, " n"]  # rows of the `Splats`, nearest first, culled ones last
    corner: Int[Array, "n 2"]  # first tile column and row
    extent: Int[Array, "n 2"]  # number of columns and rows; zero when culled
    ellipses: Float[Array, "n 8"]  # for `touches_tile`
    blurs: Float[Array, "n 8"] | None  # those of slanted splats, which are drawn in them too


class Cursor(NamedTuple):
    """Start of the next round: a slab of splats, and a slot within it."""

    slab: Int[Array, ""]
    slot: Int[Array, ""]

    @classmethod
    def start(cls) -> "Cursor":
        return cls(jnp.int32(0), jnp.int32(0))


class Lists(NamedTuple):
    """Slots of a round: tile t holds ranks[starts[t] : starts[t + 1]], nearest first."""

    ranks: Int[Array, " capacity"]  # positions in the depth order
    starts: Int[Array, " tiles+1"]


class Round(NamedTuple):
    """Lists of a round, and the start of the following round."""

    lists: Lists
    following: Cursor


def tile_boxes(splats: Splats, grid: Grid) -> Boxes:
    """Returns the depth order, and the tiles whose pixel centres each splat's extent covers."""
    size = jnp.array([grid.width, grid.height], splats.means2d.dtype)
    first = jnp.maximum(jnp.ceil(splats.means2d - splats.extents - 0.5), 0)
    last = jnp.minimum(jnp.floor(splats.means2d + splats.extents - 0.5), size[None, :] - 1)
    visible = jnp.all((splats.extents > 0) & (last >= first), axis=1)
    order = depth_order(splats.depths, visible)
    shown = visible[:, None]
    first, last = (jnp.where(shown, pixel, 0).astype(jnp.int32) // TILE for pixel in (first, last))
    extent = jnp.where(shown, last - first + 1, 0)
    if splats.slants is None:
        return Boxes(order, first[order], extent[order], ellipses_of(splats)[order], None)
    ellipses, blurs = slanted_ellipses_of(splats)
    return Boxes(order, first[order], extent[order], ellipses[order], blurs[order])


def ellipses_of(splats: Splats) -> Float[Array, "n 8"]:
    """Returns the ellipses of splats that have no slants, for `touches_tile`."""
    reach = 2 * jnp.log(jnp.maximum(splats.opacities, MIN_ALPHA) / MIN_ALPHA)
    return ellipse_rows(splats.means2d, splats.sqrt_conics, reach)


def slanted_ellipses_of(splats: Splats) -> tuple[Float[Array, "n 8"], Float[Array, "n 8"]]:
    """Returns the ellipses of slanted splats and those of their blurs, for `touches_tile`."""
    slants = slants_of(splats)
    found = along_rays.bounds(splats.sqrt_conics, slants, splats.opacities)
    reach = 2 * jnp.log(jnp.maximum(splats.opacities, MIN_ALPHA) / MIN_ALPHA)
    root = jnp.sqrt(slants[:, 5])
    blurs = jnp.stack([root, jnp.zeros_like(root), root], axis=1)
    return (
        ellipse_rows(splats.means2d + found.offsets, found.sqrt_conics, found.reach),
        ellipse_rows(splats.means2d, blurs, reach),
    )


def ellipse_rows(
    centres: Float[Array, "n 2"], sqrt_conics: Float[Array, "n 3"], reach: Float[Array, " n"]
) -> Float[Array, "n 8"]:
    """Returns rows for `touches_tile`: centre x, y, u, v, w, the slopes dx/dy and dy/dx, reach^2.

    The slopes are those from the centre to the points of least distance on horizontal and vertical lines.
    """
    u, v, w = sqrt_conics.T
    # A margin for rounding: an extra tile costs time, a missing one would lose pixels.
    columns = [u, v, w, -v / u, -u * v / (v * v + w * w), 1.001 * reach + 1e-3]
    return jnp.concatenate([centres, jnp.stack(columns, axis=1)], axis=1)


def capacity_of_round(splats: int, grid: Grid) -> int:
    """Returns the number of slots in a round. It affects speed, but not the image."""
    wanted = bits_for(max(SLOTS_PER_TILE * grid.tiles, SLOTS_PER_SPLAT * splats))
    return 1 << min(max(wanted, CAPACITY_BITS[0]), CAPACITY_BITS[1])


def slabs_of(splats: int, grid: Grid) -> tuple[int, int]:
    """Returns the number of slabs and their size in splats, so that int32 can count the slots of each.

    There is almost always one slab.
    """
    size = min(splats, MAX_SLOTS // grid.tiles)
    return -(-splats // size), size


def bin_round(cursor: Cursor, boxes: Boxes, grid: Grid) -> Round:
    """Lists the next slots of a slab by tile, without slots whose ellipse misses the tile."""
    n = boxes.order.shape[0]
    _, size = slabs_of(n, grid)
    capacity = capacity_of_round(n, grid)
    base = jnp.minimum(cursor.slab * size, n - size)
    own = base + jnp.arange(size, dtype=jnp.int32) >= cursor.slab * size
    count = jnp.where(
        own, jnp.prod(lax.dynamic_slice_in_dim(boxes.extent, base, size), axis=1, dtype=jnp.int32), 0
    )
    ends = jnp.cumsum(count, dtype=jnp.int32) - cursor.slot
    starts, left = ends - count, ends[-1]

    # The rank of a slot is one less than the number of splats that begin at or before it.
    begun = jnp.sum(~own | ((count > 0) & (starts <= 0)), dtype=jnp.int32)
    begins = jnp.where((count > 0) & (starts > 0), starts, capacity)
    begin_here = jnp.zeros(capacity, jnp.int32).at[begins].set(1, mode="drop")
    # The barriers here and below keep XLA from recomputing the values inside every gather.
    ranks = lax.optimization_barrier(base + begun - 1 + jnp.cumsum(begin_here, dtype=jnp.int32))

    slot = jnp.arange(capacity, dtype=jnp.int32)
    inside = slot - starts[ranks - base]
    columns = jnp.maximum(boxes.extent[ranks, 0], 1)
    down = lax.div(inside, columns)
    column = boxes.corner[ranks, 0] + inside - down * columns
    row = boxes.corner[ranks, 1] + down
    corner = (jnp.stack([column, row], axis=1) * TILE).astype(boxes.ellipses.dtype)
    touches = touches_tile(boxes.ellipses[ranks], corner)
    if boxes.blurs is not None:
        touches |= touches_tile(boxes.blurs[ranks], corner)
    hit = (slot < left) & touches
    tile = jnp.where(hit, row * grid.columns + column, grid.tiles).astype(jnp.uint32)
    tile = lax.optimization_barrier(tile)
    order = stable_order(tile)
    tile_starts = jnp.searchsorted(tile[order], jnp.arange(grid.tiles + 1, dtype=jnp.uint32))

    done = left <= capacity
    following = Cursor(cursor.slab + done.astype(jnp.int32), jnp.where(done, 0, cursor.slot + capacity))
    return Round(Lists(ranks[order], tile_starts.astype(jnp.int32)), following)


def touches_tile(ellipses: Float[Array, "m 8"], corner: Float[Array, "m 2"]) -> Bool[Array, " m"]:
    """Returns whether alpha reaches 1/255 in the rectangle of a tile's pixel centres.

    The squared Mahalanobis distance is convex, so its minimum over a rectangle is on an edge that faces the
    mean. On each of these edges one coordinate is fixed, and the other is clipped to its optimum.
    """
    x, y, u, v, w, x_per_y, y_per_x, reach = ellipses.T
    left, top = corner.T
    near_x, far_x = left + 0.5 - x, left + (TILE - 0.5) - x
    near_y, far_y = top + 0.5 - y, top + (TILE - 0.5) - y
    edge_x, edge_y = jnp.clip(0, near_x, far_x), jnp.clip(0, near_y, far_y)
    best_x = jnp.clip(x_per_y * edge_y, near_x, far_x)
    best_y = jnp.clip(y_per_x * edge_x, near_y, far_y)

    def distance(dx, dy):
        return jnp.square(u * dx + v * dy) + jnp.square(w * dy)

    return jnp.minimum(distance(edge_x, best_y), distance(best_x, edge_y)) <= reach
