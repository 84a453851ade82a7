"""The splats of a step on several devices: sent from the owners of rows to the drawers of views, and back.

    owner     own rows in each view  ->  packed: those that the view shows  ->  pieces
    drawer    pieces of all owners   ->  all rows, in the order of the scene

A row that a view does not show stays where it is: its splat is culled at the drawer, and its cotangent is
zero. The others are sent in pieces of one size, as many as the fullest device needs, so no row can be cut
off. If a view shows more than half of the rows of a device, all rows of the step are sent at once instead.
Devices that share the memory of one process always send all: copying costs them less than packing.

All functions but `share_memory` are for the inside of `shard_map`.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from splatax.training.devices import AXIS, by_owner, in_scene, own_views, sent_to_drawers, sent_to_owners
from splatax.training.step import Shown

PIECES = 8  # of the rows of a device
MOST = PIECES // 2  # pieces of a step; one that needs more sends all rows at once


class Travel(NamedTuple):
    """The rows of a step that are sent one way: from their owners, or back to them.

    Attributes:
        leaving: rows that this device sends, in the form that `Way.send` takes.
        coming: rows that it gets, in the form that `Way.send` returns.
        pieces: number of pieces that hold them; above `MOST`, all rows are sent.
    """

    leaving: Bool[Array, "_ owners rows"]
    coming: Bool[Array, "_ owners rows"]
    pieces: Int[Array, ""]

    def back(self) -> "Travel":
        """Returns the same rows on their way back."""
        return Travel(self.coming, self.leaving, self.pieces)


class Way(NamedTuple):
    """A way that rows are sent: to the drawers of views, or back to the owners.

    Attributes:
        by_owner: gives rows an axis of owners, after that of views.
        send: sends rows with this axis. A drawer has the rows of all owners, an owner only its own.
        joined: returns rows without this axis.
    """

    by_owner: Callable[[Array], Array]
    send: Callable[[Array], Array]
    joined: Callable[[Array], Array]


def share_memory(mesh: Mesh) -> bool:
    """Returns whether the devices are processors of one process, such as the host devices of JAX."""
    devices = list(mesh.devices.flat)
    return all(each.platform == "cpu" and each.process_index == devices[0].process_index for each in devices)


def travel_of(extents: Float[Array, "k rows 2"]) -> Travel:
    """Returns which rows travel to the drawers, from the extents of own rows in all views."""
    shown = jnp.any(extents > 0, axis=2)
    most = lax.pmax(jnp.max(jnp.sum(shown, axis=1)), AXIS)
    shown = shown[:, None]
    return Travel(shown, sent_to_drawers(shown), -(-most // (shown.shape[2] // PIECES)))


def to_drawers(view: Shown, travel: Travel | None) -> Shown:
    """Returns the rows of all devices in own views, from own rows in all views.

    Without `travel`, all rows are sent at once. What all devices know is not sent: `pull`, which is zero, and
    the width of a panorama.
    """
    splats = view.splats
    way = Way(lambda rows: rows[:, None], sent_to_drawers, in_scene)
    there = _sent(view._replace(splats=replace(splats, pull=None, period=None)), way, travel)
    pull = None if splats.pull is None else jnp.zeros_like(there.splats.means2d)
    period = None if splats.period is None else own_views(splats.period)
    return there._replace(splats=replace(there.splats, pull=pull, period=period))


def to_owners(d_view: Shown, travel: Travel | None) -> Shown:
    """Returns the cotangents of own rows in all views, from those of all rows in own views.

    `travel` is that to the drawers; without it, all rows are sent at once. Extents and periods have no
    cotangents.
    """
    splats = d_view.splats
    unknown: Any = None  # in place of an array
    way = Way(by_owner, sent_to_owners, lambda rows: rows[:, 0])
    back = _sent(
        d_view._replace(splats=replace(splats, extents=unknown, period=None)),
        way,
        None if travel is None else travel.back(),
    )
    views, rows, _ = back.splats.means2d.shape
    extents = jnp.zeros((views, rows, 2), splats.extents.dtype)
    period = None if splats.period is None else jnp.zeros(views, splats.period.dtype)
    return back._replace(splats=replace(back.splats, extents=extents, period=period))


def _sent(view: Shown, way: Way, travel: Travel | None) -> Shown:
    """Sends the arrays of a view, whose first axes are views and rows."""
    if lax.axis_size(AXIS) == 1:
        return view
    rows = view.splats.depths.shape[1]
    leaves, tree = jax.tree.flatten(view)
    columns = [_columns(leaf, rows) for leaf in leaves]
    ends = np.cumsum([column.shape[2] for column in columns])

    def every(columns, _):
        return [way.joined(way.send(way.by_owner(column))) for column in columns]

    def some(columns, travel):
        packed = _packed(way.by_owner(jnp.concatenate(columns, axis=2)), travel.leaving)
        come = _unpacked(_in_pieces(packed, way.send, travel.pieces), travel.coming)
        return jnp.split(way.joined(come), ends[:-1], axis=2)

    if travel is None:
        found = every(columns, travel)
    else:
        found = lax.cond(travel.pieces > MOST, every, some, columns, travel)
    shapes = [(leaf.shape[1] // rows, *leaf.shape[2:]) for leaf in leaves]
    return jax.tree.unflatten(tree, [_rows(*pair) for pair in zip(found, shapes, strict=True)])


def _columns(leaf: Array, rows: int) -> Float[Array, "views rows c"]:
    """Returns all numbers of each row side by side.

    The channels of a panorama have a second set of rows, for the copies beyond its seam.
    """
    by_copy = leaf.reshape(leaf.shape[0], leaf.shape[1] // rows, rows, -1)
    return jnp.moveaxis(by_copy, 1, 2).reshape(leaf.shape[0], rows, -1)


def _rows(columns: Float[Array, "views rows c"], shape: tuple[int, ...]) -> Array:
    """Returns the inverse of `_columns`; `shape` has the number of copies, and what belongs to a row."""
    views, rows, _ = columns.shape
    copies, *row = shape
    by_copy = jnp.moveaxis(columns.reshape(views, rows, copies, -1), 2, 1)
    return by_copy.reshape(views, copies * rows, *row)


def _packed(rows: Float[Array, "a b n c"], which: Bool[Array, "a b n"]) -> Float[Array, "a b m c"]:
    """Returns the chosen rows in their order, in the first of as many places as `MOST` pieces have."""
    most = rows.shape[2] // PIECES * MOST

    def one(rows, which):
        return rows[jnp.nonzero(which, size=most, fill_value=0)[0]]

    return jax.vmap(jax.vmap(one))(rows, which)


def _unpacked(packed: Float[Array, "a b m c"], which: Bool[Array, "a b n"]) -> Float[Array, "a b n c"]:
    """Returns the inverse of `_packed`; rows that were not chosen are zero."""
    place = jnp.clip(jnp.cumsum(which, axis=2) - 1, 0, packed.shape[2] - 1)
    return jnp.where(which[..., None], jnp.take_along_axis(packed, place[..., None], axis=2), 0)


def _in_pieces(
    packed: Float[Array, "a b m c"], send: Callable[[Array], Array], pieces: Int[Array, ""]
) -> Float[Array, "d e m c"]:
    """Sends as many pieces of packed rows as hold something."""
    size = packed.shape[2] // MOST

    def one(number, come):
        piece = send(lax.dynamic_slice_in_dim(packed, number * size, size, axis=2))
        return lax.dynamic_update_slice_in_dim(come, piece, number * size, axis=2)

    nothing = jax.eval_shape(send, packed)
    return lax.fori_loop(0, pieces, one, jnp.zeros(nothing.shape, nothing.dtype))
