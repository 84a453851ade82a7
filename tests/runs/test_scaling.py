"""The model of many devices, and the command that prints it."""

import jax
import jax.numpy as jnp
import pytest

import splatax as sx
from splatax import cli
from splatax.cli.plan import devices_of, number_of, size_of
from splatax.errors import InputError
from splatax.runs.scaling import MACHINES, STATE, cost
from splatax.training.loop import first_state

HD = 1920 * 1080


def test_one_device_exchanges_nothing_and_waits_for_nobody():
    found = cost(MACHINES["H100"], 1, 1_000_000, HD, 0.5)
    assert (found.travel, found.wait, found.exchanged) == (0, 0, 0)
    assert found.step == found.rows + found.draw


def test_devices_share_rows_and_memory_but_each_draws_a_view():
    one, eight = (cost(MACHINES["H100"], n, 10_000_000, HD, 0.2) for n in (1, 8))
    assert eight.rows < one.rows
    assert eight.memory < one.memory
    assert eight.draw > one.draw  # the slowest of eight


def test_the_gaussians_that_one_device_draws_do_not_shrink_with_more_devices_but_its_state_does():
    eight, many = (cost(MACHINES["H100"], n, 10_000_000, HD, 0.2) for n in (8, 64))
    assert many.memory < eight.memory
    assert many.state < eight.state
    assert many.whole == eight.whole > 2.36, "ten million rows of 59 numbers, and their splats"
    assert eight.peak < 7.16, "no device holds the state of the scene, which has 7.16 GB"


def test_a_state_has_as_many_bytes_for_a_gaussian_as_the_model_counts():
    gaussians = sx.Gaussians(*(jnp.zeros((8, *shape)) for shape in ((3,), (4,), (3,), (), (16, 3))))
    state = first_state(gaussians, sx.recipes.default(steps=10), 1.0, 3)
    rows = [leaf.nbytes for leaf in jax.tree.leaves(state) if leaf.shape[:1] == (8,)]
    assert sum(rows) == 8 * STATE


def test_traffic_between_hosts_takes_longer_than_within():
    eight, nine = (cost(MACHINES["H100"], n, 10_000_000, HD, 0.2) for n in (8, 16))
    assert nine.travel > eight.travel


def test_what_does_not_fit_is_said(capsys):
    cli.main(["plan", "--devices", "1xCPU", "--gaussians", "1G"])
    assert "does not fit in the 64 GB of a device: with 1 devices" in capsys.readouterr().out
    cli.main(["plan", "--devices", "64xH100", "--gaussians", "250M"])
    assert "the 80 GB of a device: with 1, 8 devices" in capsys.readouterr().out


def test_the_command_says_that_nothing_was_measured(capsys):
    cli.main(["plan"])
    assert "no such machine was measured" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("read", "text"),
    [(devices_of, "8"), (devices_of, "0xH100"), (devices_of, "8xTPU"), (number_of, "many"), (number_of, "0"),
     (size_of, "4k"), (size_of, "0x10")],
)  # fmt: skip
def test_values_that_make_no_sense_are_refused_with_an_example(read, text):
    with pytest.raises(InputError, match=text):
        read(text)


def test_numbers_and_sizes_are_read_with_their_units():
    assert number_of("10M") == 10_000_000
    assert number_of("1.5k") == 1_500
    assert size_of("640x480") == (640, 480)
    assert devices_of("64xA100") == (64, MACHINES["A100"])
