"""Every new row finds the row that it is made from, wherever the devices hold it."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from splatax.training.devices import BLOCK, by_device
from splatax.training.routes import routes


def found(parents, devices, before, after):
    """The parent of each new row as its device finds it by the routes, in the order of the scene."""
    ways = routes(parents, devices, before, after)
    held = by_device(np.arange(before), devices).reshape(devices, -1)
    new = np.empty((devices, after // devices), int)
    for block in range(after // devices // BLOCK):
        sent = [held[device][ways.sent[device, block]] for device in range(devices)]
        for device in range(devices):
            got = np.concatenate([held[device], *(rows[device] for rows in sent)])
            new[device, block * BLOCK : (block + 1) * BLOCK] = got[ways.taken[device, block]]
    return new.reshape(devices, -1, BLOCK).swapaxes(0, 1).ravel()[: len(parents)]


@pytest.mark.parametrize("devices", [1, 2, 3, 8])
@pytest.mark.parametrize("kind", ["stay", "shift", "any", "one for all", "none"])
def test_each_row_gets_its_parent(devices, kind):
    before, after = 2 * devices * BLOCK, 4 * devices * BLOCK
    count, rng = 3 * devices * BLOCK + 17, np.random.default_rng(0)
    parents = {
        "stay": np.arange(before),
        "shift": np.arange(5, before),
        "any": rng.integers(before, size=count),
        "one for all": np.full(count, BLOCK + 3),
        "none": np.arange(0),
    }[kind]
    assert_array_equal(found(parents, devices, before, after), parents)


def test_rows_that_stay_on_their_device_are_not_sent():
    ways = routes(np.arange(4 * BLOCK), 2, 4 * BLOCK, 8 * BLOCK)
    assert ways.sent.shape == (2, 4, 2, 1)
    assert np.all(ways.taken < 2 * BLOCK)


def test_an_exchange_is_as_large_as_its_largest_part():
    parents = np.arange(4 * BLOCK)
    parents[:100] = BLOCK + np.arange(100)  # the first device needs a hundred rows of the second
    assert routes(parents, 2, 4 * BLOCK, 4 * BLOCK).sent.shape == (2, 2, 2, 128)
