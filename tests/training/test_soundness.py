"""What is not finite goes no further than the step that meets it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import splatax as sx
from splatax.training import faults
from splatax.training.density import Fixed
from splatax.training.feed import batches
from splatax.training.loop import RunState, first_state, optimize
from splatax.training.step import train_step
from training.test_training import RECIPE, capture

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
ONE = replace(RECIPE, steps=6, density=Fixed(), backend="xla")


def with_number(gaussians, field, number, row=7):
    leaf = getattr(gaussians, field)
    return replace(gaussians, **{field: leaf.at[(row,) + (0,) * (leaf.ndim - 1)].set(number)})


def start():
    dataset = capture()
    gaussians = ONE.initialization(dataset, 1, 0)
    return dataset, first_state(gaussians, ONE, dataset.extent, 5)


@pytest.mark.parametrize("number", [np.nan, np.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_a_gaussian_that_is_not_finite_is_removed_and_the_run_goes_on(field, number):
    dataset, state = start()
    state = replace(state, gaussians=with_number(state.gaussians, field, number))
    for progress in optimize(dataset, ONE, RunState(state, 80)):
        assert progress.step == 1 or np.isfinite(progress.loss)
        assert [int(n) for n in progress.faults] == [1, 1]
    gaussians = progress.gaussians
    assert np.isneginf(gaussians.opacity_logits[7])
    gaussians = replace(gaussians, opacity_logits=gaussians.opacity_logits.at[7].set(0))
    for leaf in jax.tree.leaves((gaussians, progress.state.train.opt_state)):
        assert np.isfinite(leaf).all()


def test_a_step_that_is_left_out_changes_nothing_but_the_count_of_steps():
    dataset, state = start()
    broken = replace(state, gaussians=with_number(state.gaussians, "sh", np.nan))
    before = jax.tree.map(np.array, state.gaussians)
    after, loss = train_step(broken, next(batches(dataset.train, 0)), ONE)
    assert np.isnan(loss)
    assert int(after.step) == 1
    assert int(after.opt_state.count) == 0
    others = np.arange(80) != 7
    for a, b in zip(jax.tree.leaves(after.gaussians), jax.tree.leaves(before), strict=True):
        assert_array_equal(a[others], b[others])


def test_a_gradient_that_is_not_finite_accuses_its_gaussian_alone_if_the_loss_is():
    _, state = start()
    gradients = with_number(jax.tree.map(jnp.zeros_like, state.gaussians), "means", np.inf)
    fine, at_fault = faults.find(state.gaussians, gradients, (), jnp.float32(0.5))
    assert (bool(fine), np.flatnonzero(at_fault).tolist()) == (False, [7])
    fine, at_fault = faults.find(state.gaussians, gradients, (), jnp.float32(np.nan))
    assert (bool(fine), at_fault.any()) == (False, False)
    fine, _ = faults.find(state.gaussians, gradients, jnp.array([np.nan]), jnp.float32(0.5))
    assert not fine


def test_empty_slots_and_flat_gaussians_are_no_fault():
    _, state = start()
    gaussians = with_number(with_number(state.gaussians, "opacity_logits", -np.inf), "log_scales", -np.inf)
    fine, at_fault = faults.find(gaussians, jax.tree.map(jnp.zeros_like, gaussians), (), jnp.float32(0))
    assert fine
    assert not at_fault.any()


def test_a_scene_that_is_not_finite_is_not_written(tmp_path):
    _, state = start()
    with pytest.warns(UserWarning, match="left out 1 Gaussians that are not finite"):
        sx.save(tmp_path / "scene.ply", with_number(state.gaussians, "means", np.nan))
    assert len(sx.load(tmp_path / "scene.ply")) == 79
