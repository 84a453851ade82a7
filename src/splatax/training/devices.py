"""The devices of a run, and which rows of the scene each of them owns.

Rows are distributed in blocks of `BLOCK`: block b belongs to device b mod D, so a scene that keeps its living
Gaussians first stays balanced. The computation for a row depends only on its block, never on D: XLA rounds
elementwise work differently for arrays of other lengths, so work on rows is done in blocks of one length.

Only this file and `routes` know on which device a row is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from splatax.training.capacity import pad
from splatax.training.random_keys import is_key
from splatax.training.step import TrainState

AXIS = "device"
BLOCK = 1024  # rows
PIECE = 256_000_000  # bytes that are on a device at a time when rows of all are copied to the host
AnyArray = TypeVar("AnyArray", Array, np.ndarray)  # on the host or on a device
ROWS, VIEWS, EVERYWHERE = PartitionSpec(AXIS), PartitionSpec(AXIS), PartitionSpec()


def devices_for(views: int, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Returns the devices that share a step of so many views, as many of them as divide the views.

    Args:
        views: of a step.
        devices: to choose from, the first ones; None for all that JAX has, of all processes.

    Raises:
        ValueError: if the list is empty, or if devices are named or there are several processes, and they do
            not divide the views.
    """
    found = list(jax.devices() if devices is None else devices)
    if not found:
        raise ValueError("no devices are given. Give at least one, or None for all.")
    count = max(d for d in range(1, min(len(found), views) + 1) if views % d == 0)
    if count != len(found) and (devices is not None or jax.process_count() > 1):
        raise ValueError(
            f"{views} views per step do not divide among {len(found)} devices. Choose a multiple "
            f"of {len(found)} views, or give {count} devices."
        )
    return Mesh(np.array(found[:count]), (AXIS,), axis_types=(AxisType.Auto,))


def is_by_row(leaf: Array, rows: int) -> bool:
    """Returns whether an array has a first axis of so many rows."""
    return leaf.ndim > 0 and leaf.shape[0] == rows


def placement(state: TrainState) -> TrainState:
    """Returns where each array of a state lives: rows of the scene on their owners, all else everywhere."""
    rows = state.gaussians.means.shape[0]

    def by_row(leaf: Array) -> PartitionSpec:
        return ROWS if is_by_row(leaf, rows) else EVERYWHERE

    everywhere = jax.tree.map(lambda _: EVERYWHERE, state)
    return replace(
        everywhere,
        gaussians=jax.tree.map(by_row, state.gaussians),
        opt_state=jax.tree.map(by_row, state.opt_state),
        density_state=jax.tree.map(by_row, state.density_state),
    )


@dataclass(frozen=True)
class Sharding:
    """The state of a run on several devices.

    Attributes:
        mesh: the devices.
    """

    mesh: Mesh

    @property
    def by_processes(self) -> bool:
        """True if the devices are those of several processes."""
        return len({device.process_index for device in self.mesh.devices.flat}) > 1

    def connect(self) -> None:
        """Connects the devices by a sum over them, to which all processes come at the same time.

        Processes wait 30 s for each other at their first collective operation and 30 minutes at later ones,
        and a step may take longer to compile on one of them.
        """
        ones = self.views(np.ones(len(self.drawn_here(self.mesh.size)), np.float32), self.mesh.size)
        total = partial(lax.psum, axis_name=AXIS)
        summed = jax.jit(jax.shard_map(total, mesh=self.mesh, in_specs=VIEWS, out_specs=EVERYWHERE))
        jax.block_until_ready(summed(ones))

    def placed(self, state: TrainState) -> TrainState:
        """Copies a state whose rows are in order onto the devices; empty slots fill up the blocks.

        Each device gets at least two blocks: XLA compiles a loop that runs once with what surrounds it, which
        then rounds differently.
        """
        state = _padded(state, self.rows_for(len(state.gaussians)))
        return jax.tree.map(self._put, state, placement(state))

    def rows_for(self, rows: int) -> int:
        """Returns the number of rows on all devices together, for so many of the scene; see `placed`."""
        unit = self.mesh.size * BLOCK
        return max(-(-rows // unit), 2) * unit

    def gathered(self, state: TrainState, rows: int) -> TrainState:
        """Copies a state to every process: its first rows, in order, to the host, all else to a device."""
        return jax.tree.map(partial(self._get, rows=rows), state, placement(state))

    def in_order(self, arrays: Any, rows: int) -> Any:
        """Copies the first `rows` rows of arrays to the host, in order. Every process gets all of them."""
        return jax.tree.map(partial(self._get, place=ROWS, rows=rows), arrays)

    def rows(self, leaf: np.ndarray) -> Array:
        """Sends each device its own rows of an array whose rows are in order."""
        return self._put(leaf, ROWS)

    def by_first_axis(self, leaf: np.ndarray) -> Array:
        """Sends each device its own entry of an array with one for each device."""
        return self._sent(leaf, ROWS)

    def views(self, leaf: np.ndarray, views: int) -> Array:
        """Sends arrays of the views that this process draws to the devices that draw them."""
        sharding = NamedSharding(self.mesh, VIEWS)
        return jax.make_array_from_process_local_data(sharding, leaf, (views, *leaf.shape[1:]))

    def everywhere(self, leaf: np.ndarray) -> Array:
        """Copies an array that all processes have to all devices."""
        return self._sent(leaf, EVERYWHERE)

    def drawn_here(self, views: int) -> range:
        """Returns the views of a step that devices of this process draw."""
        own = [i for i, d in enumerate(self.mesh.devices.flat) if d.process_index == jax.process_index()]
        each = views // self.mesh.size
        return range(own[0] * each, (own[-1] + 1) * each) if own else range(0)

    def _put(self, leaf: Array | np.ndarray, place: PartitionSpec) -> Array:
        if is_key(leaf):
            return jax.random.wrap_key_data(self._put(jax.random.key_data(leaf), place))
        host = np.asarray(leaf)
        if place == ROWS:
            host = by_device(host, self.mesh.size)
        return self._sent(host, place)

    def _sent(self, host: np.ndarray, place: PartitionSpec) -> Array:
        # `jax.device_put` would compare what all processes have, which must not run beside other work.
        sharding = NamedSharding(self.mesh, place)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    def _get(self, leaf: Array, place: PartitionSpec, rows: int) -> Any:
        if is_key(leaf):
            return jax.random.wrap_key_data(self._get(jax.random.key_data(leaf), place, rows))
        # Copies: a view of a device array keeps the next step from using its memory again.
        if place != ROWS:
            return jnp.array(np.asarray(leaf))
        host = self._in_pieces(leaf) if self.by_processes else np.asarray(leaf)
        return np.array(in_order(host, self.mesh.size)[:rows])

    def _in_pieces(self, leaf: Array) -> np.ndarray:
        """Copies the rows of devices of several processes to the host, few at a time for want of memory."""
        own = leaf.shape[0] // self.mesh.size
        found = np.empty((self.mesh.size, own, *leaf.shape[1:]), leaf.dtype)
        size = min(max(PIECE // (leaf.nbytes // own), 1), own)
        for start in range(0, own, size):
            first = min(start, own - size)
            found[:, first : first + size] = np.asarray(_piece(leaf, jnp.int32(first), size, self.mesh))
        return found.reshape(leaf.shape)


@partial(jax.jit, static_argnames=("size", "mesh"))
def _piece(leaf: Array, start: Array, size: int, mesh: Mesh) -> Array:
    """Returns some rows of each device, on all devices: an array [devices, rows, ...]."""

    def on_each(leaf, start):
        return lax.all_gather(lax.dynamic_slice_in_dim(leaf, start, size), AXIS)

    return jax.shard_map(
        on_each, mesh=mesh, in_specs=(ROWS, EVERYWHERE), out_specs=EVERYWHERE, check_vma=False
    )(leaf, start)


def by_device(rows: AnyArray, devices: int) -> AnyArray:
    """Returns rows by device, from rows in order."""
    blocks = rows.reshape(-1, devices, BLOCK, *rows.shape[1:])
    return blocks.swapaxes(0, 1).reshape(rows.shape)


def in_order(rows: AnyArray, devices: int) -> AnyArray:
    """Returns rows in order, from rows by device."""
    blocks = rows.reshape(devices, -1, BLOCK, *rows.shape[1:])
    return blocks.swapaxes(0, 1).reshape(rows.shape)


def sent_to_drawers(leaf: Array) -> Array:
    """Sends rows [all views, 1, own rows] to [own views, owners, their rows]. Inside `shard_map`."""
    return lax.all_to_all(leaf, AXIS, split_axis=0, concat_axis=1, tiled=True)


def sent_to_owners(leaf: Array) -> Array:
    """Sends rows [own views, owners, their rows] to [all views, 1, own rows]. Inside `shard_map`."""
    return lax.all_to_all(leaf, AXIS, split_axis=1, concat_axis=0, tiled=True)


def in_scene(leaf: Array) -> Array:
    """Returns rows [views, all rows in the order of the scene], from [views, owners, their rows]."""
    views, owners, rows = leaf.shape[:3]
    by_view = leaf.reshape(views, owners * rows, *leaf.shape[3:])
    return jax.vmap(partial(in_order, devices=owners))(by_view)


def by_owner(leaf: Array) -> Array:
    """Returns rows [views, owners, their rows], from [views, all rows in order]. Inside `shard_map`."""
    owners = lax.axis_size(AXIS)
    by_view = jax.vmap(partial(by_device, devices=owners))(leaf)
    return by_view.reshape(leaf.shape[0], owners, -1, *leaf.shape[2:])


def own_views(leaf: Array) -> Array:
    """Returns the part of an array with one row for each view that is of this device. Inside `shard_map`."""
    each = leaf.shape[0] // lax.axis_size(AXIS)
    return lax.dynamic_slice_in_dim(leaf, lax.axis_index(AXIS) * each, each)


def from_all_views(leaf: Array) -> Array:
    """Returns the rows of all views, from those of this device. Inside `shard_map`."""
    return lax.all_gather(leaf, AXIS, tiled=True)


def by_block(function: Callable[..., Any], *rows: Any) -> Any:
    """Applies a function to each block of own rows, with its number in the scene. Inside `shard_map`.

    Args:
        function: gets the number of a block and its part of each of `rows`; returns arrays of so many rows.
        rows: pytrees of arrays with a first axis of own rows.
    """
    blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, BLOCK, *leaf.shape[1:]), rows)
    numbers = own_blocks(jax.tree.leaves(rows)[0].shape[0])
    results = lax.map(lambda block: function(block[0], *block[1]), (numbers, blocks))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), results)


def own_blocks(rows: int) -> Int[Array, " blocks"]:
    """Returns the numbers in the scene of the blocks of own rows. Inside `shard_map`."""
    return jnp.arange(rows // BLOCK) * lax.axis_size(AXIS) + lax.axis_index(AXIS)


def sum_in_order(blocks: Array) -> Array:
    """Returns the sum over the blocks of all devices, added in the order of the scene. Inside `shard_map`."""
    gathered = lax.all_gather(blocks, AXIS, axis=1)
    ordered = gathered.reshape(-1, *blocks.shape[1:])
    return lax.scan(lambda total, block: (total + block, None), jnp.zeros_like(ordered[0]), ordered)[0]


def _padded(state: TrainState, rows: int) -> TrainState:
    """Returns a state with empty slots at its end, so that it has `rows` rows."""
    places, more = placement(state), rows - len(state.gaussians)

    def padded(leaf: Array, place: PartitionSpec) -> Array:
        return jnp.pad(leaf, [(0, more)] + [(0, 0)] * (leaf.ndim - 1)) if place == ROWS else leaf

    other = partial(jax.tree.map, padded)
    return replace(
        state,
        gaussians=pad(state.gaussians, rows) if more else state.gaussians,
        opt_state=other(state.opt_state, places.opt_state),
        density_state=other(state.density_state, places.density_state),
    )
