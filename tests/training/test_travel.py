"""Rows that a view shows are packed, sent in pieces and unpacked; test_devices.py sends them for real."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from splatax.training.travel import MOST, PIECES, _columns, _in_pieces, _packed, _rows, _unpacked

ROWS = 64


def chosen(count, seed=0):
    """Which of `ROWS` rows travel, for two views and three devices; so many of each."""
    order = np.random.default_rng(seed).permuted(np.tile(np.arange(ROWS), (2, 3, 1)), axis=2)
    return jnp.asarray(order < count)


@pytest.mark.parametrize("count", [0, 1, ROWS // PIECES, ROWS // PIECES + 1, ROWS // PIECES * MOST])
def test_rows_that_are_packed_and_sent_come_back_to_their_places_and_the_others_are_zero(count):
    rows = jnp.asarray(np.random.default_rng(1).normal(size=(2, 3, ROWS, 5)), jnp.float32)
    which = chosen(count)
    pieces = jnp.int32(-(-count * PIECES // ROWS))
    come = _unpacked(_in_pieces(_packed(rows, which), lambda piece: piece, pieces), which)
    assert_array_equal(come, np.where(np.asarray(which)[..., None], rows, 0))


def test_pieces_that_hold_nothing_are_not_sent():
    packed = jnp.ones((2, 3, MOST * 8, 5))
    come = _in_pieces(packed, lambda piece: piece, jnp.int32(3))
    assert_array_equal(come[:, :, : 3 * 8], 1)
    assert_array_equal(come[:, :, 3 * 8 :], 0)


@pytest.mark.parametrize("shape", [(ROWS,), (ROWS, 2), (2 * ROWS, 3)])
def test_the_numbers_of_a_row_lie_side_by_side_also_those_of_its_copy_beyond_a_seam(shape):
    leaf = jnp.arange(4 * np.prod(shape), dtype=jnp.float32).reshape(4, *shape)
    columns = _columns(leaf, ROWS)
    assert columns.shape[:2] == (4, ROWS)
    copies = leaf.reshape(4, -1, ROWS, *shape[1:])
    assert_array_equal(columns[1, 7], copies[1, :, 7].ravel())
    assert_array_equal(_rows(columns, (shape[0] // ROWS, *shape[1:])), leaf)
