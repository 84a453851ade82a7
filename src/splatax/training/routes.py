"""The rows that the devices of a run send each other when each new row is made from one of the old ones.

New rows are made block by block. For one block of each device, every device sends every other one the rows
that it needs, in one all-to-all exchange of equal parts: as large as the largest of them, which is counted
when the routes are planned, so that none is cut.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from splatax.training.capacity import across
from splatax.training.devices import AXIS, BLOCK
from splatax.training.protocols import HostOrDevice


class Routes(NamedTuple):
    """The exchange of each block; rows are numbered as their device holds them.

    Attributes:
        sent: rows that each device sends to each device for a block.
        taken: where each device finds the parent of each new row: in its own old rows, or after them, in what
            it gets from the others.
    """

    sent: Int[HostOrDevice, "senders blocks receivers most"]
    taken: Int[HostOrDevice, "receivers blocks rows"]


def routes(parents: Int[np.ndarray, " n"], devices: int, before: int, after: int) -> Routes:
    """Returns the routes of the parents of the first n rows of a scene.

    Args:
        parents: old row that each new row is made from, in the order of the scene. Rows after them, which are
            empty slots, get any row.
        devices: number of devices.
        before: old rows of all devices together, with empty slots.
        after: new rows of all devices together, with empty slots.
    """
    own, blocks = before // devices, after // devices // BLOCK
    receiver, place = _device_and_place(np.arange(len(parents)), devices)
    sender, row = _device_and_place(parents, devices)
    block, slot = np.divmod(place, BLOCK)
    taken = np.zeros((devices, blocks, BLOCK), np.int32)
    taken[receiver, block, slot] = row

    travels = np.flatnonzero(sender != receiver)
    part = ((sender * blocks + block) * devices + receiver)[travels]
    order = np.argsort(part, kind="stable")
    travels, part = travels[order], part[order]
    number = np.arange(len(part)) - np.searchsorted(part, part)  # within the part
    most = 1 << int(number.max(initial=0)).bit_length()  # a power of 2, so that few programs are compiled
    sent = np.zeros((devices * blocks * devices, most), np.int32)
    sent[part, number] = row[travels]
    there = receiver[travels], block[travels], slot[travels]
    taken[there] = own + sender[travels] * most + number
    return Routes(sent.reshape(devices, blocks, devices, most), taken)


def _device_and_place(
    rows: Int[np.ndarray, " n"], devices: int
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Returns the device that owns each row of the scene, and which of its rows it is."""
    block, slot = np.divmod(rows, BLOCK)
    return block % devices, block // devices * BLOCK + slot


def fetch(leaf: Array, sent: Int[Array, "receivers most"], taken: Int[Array, " rows"]) -> Array:
    """Returns the parents of one block of new rows. Inside `shard_map`.

    Args:
        leaf: own old rows.
        sent: own part of `Routes.sent` for the block.
        taken: own part of `Routes.taken` for the block.
    """
    own = len(leaf)
    got = lax.all_to_all(leaf[sent], AXIS, split_axis=0, concat_axis=0, tiled=True)
    got = got.reshape(-1, *leaf.shape[1:])
    from_others = got[jnp.maximum(taken - own, 0)]
    return jnp.where(across(taken < own, leaf.ndim), leaf[jnp.minimum(taken, own - 1)], from_others)
