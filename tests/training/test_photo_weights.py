"""Photos that do not fit the others get a lower weight in training; photos that are only harder do not."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from shortened import shortened
from splatax.training import checkpoint
from splatax.training.loop import optimize
from splatax.training.photo_weights import EqualWeights, RobustWeights
from training.test_training import RECIPE, capture

WRONG = "7.png"


def after(losses, epochs=4, weights=RobustWeights()):
    """The state after photos were seen in turn, while all losses fall to a tenth."""
    state, steps = weights.init(len(losses)), epochs * len(losses)
    for step in range(steps):
        photo = step % len(losses)
        state = weights.update(state, jnp.int32(photo), jnp.float32(losses[photo] * 0.1 ** (step / steps)))
    return weights.of_photos(state, len(losses), jnp.float32(0.9))


@pytest.mark.slow
def test_a_photo_far_above_the_others_counts_little_and_the_others_fully():
    losses = np.random.default_rng(0).uniform(0.8, 1.25, 15)
    losses[4] *= 8
    found = np.asarray(after(losses))
    assert found[4] < 0.05
    assert_array_equal(np.delete(found, 4), 1)


@pytest.mark.slow
def test_photos_of_which_some_are_harder_count_alike():
    hard = np.concatenate([np.full(20, 1.0), np.full(4, 1.9), [2.2]])
    assert_array_equal(after(hard), 1)
    widely_spread = np.exp(np.random.default_rng(1).normal(0, 0.5, 30))
    assert_array_equal(after(widely_spread), 1)


def test_all_count_alike_in_the_first_third_and_before_they_were_seen():
    weights = RobustWeights()
    state = weights.init(5)
    for photo, loss in ((0, 1.0), (1, 1.0), (2, 9.0)):
        state = weights.update(state, jnp.int32(photo), jnp.float32(loss))
    assert_array_equal(weights.of_photos(state, 5, jnp.float32(0.3)), 1)
    late = np.asarray(weights.of_photos(state, 5, jnp.float32(0.4)))
    assert late[2] < 1
    assert_array_equal(np.delete(late, 2), 1)


def spoiled():
    """A capture of which one training photo shows something else."""
    dataset = capture(views=14)
    train = tuple(
        replace(view, pixels=lambda view=view: 255 - np.flipud(view.pixels())) if view.name == WRONG else view
        for view in dataset.train
    )
    return replace(dataset, train=train)


@pytest.fixture(scope="module")
def run():
    """A run on such a capture: its recipe, the states on the way, and the state at the end."""
    recipe = replace(RECIPE, objective=replace(RECIPE.objective, weights=RobustWeights()), steps=150)
    stops = {}
    for progress in optimize(spoiled(), recipe):
        if progress.step in (11, 97):
            stops[progress.step] = checkpoint.take(progress.state, {}, {})
    return recipe, stops, checkpoint.take(progress.state, {}, {}), progress.state.train.weights


@pytest.mark.slow
def test_a_wrong_photo_is_found_in_training(run):
    found = np.asarray(run[0].objective.weights.of_photos(run[3], 13, jnp.float32(1)))
    wrong = [view.name for view in spoiled().train].index(WRONG)
    assert found[wrong] < 0.2
    assert_array_equal(np.delete(found, wrong), 1)


@pytest.mark.parametrize("stop", [11, 97])
def test_a_run_with_weights_that_was_stopped_ends_with_the_same_bits(run, tmp_path, stop):
    recipe, stops, whole, _ = run
    with (tmp_path / "run.npz").open("wb") as file:
        checkpoint.write(file, stops[stop])
    state = checkpoint.restore(checkpoint.read(tmp_path / "run.npz"), recipe)
    for progress in optimize(spoiled(), recipe, state):
        pass
    again = checkpoint.take(progress.state, {}, {})
    for path, array in whole.arrays.items():
        assert array.tobytes() == again.arrays[path].tobytes(), path


def test_steps_of_several_views_note_the_loss_of_each():
    recipe = shortened("default")
    recipe = replace(recipe, views=2, objective=replace(recipe.objective, weights=RobustWeights()))
    for progress in optimize(capture(), recipe):
        if progress.step == 2:
            break
    weights = progress.state.train.weights
    assert int(weights.seen.sum()) == int(weights.steps) == 4


def test_equal_weights_have_no_state_and_change_no_bit():
    assert jax.tree.leaves(EqualWeights().init(3)) == []
    assert EqualWeights().of_photo((), jnp.int32(0), jnp.float32(1)) == 1.0
