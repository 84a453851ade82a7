"""Any elementwise transformation of optax trains a scene, and its state follows the Gaussians."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_array_equal

from scenes import random_gaussians
from splatax.gaussians import ARRAYS, Gaussians
from splatax.training.capacity import pad
from splatax.training.optimizer import Adam, LearningRates, Optimizer, restarted, update
from training.test_training import RECIPE, capture, run

RULES = {
    "adam": Adam(),
    "rmsprop": partial(optax.rmsprop, 1.0),
    "momentum": partial(optax.sgd, 1.0, momentum=0.9),
    "lion": partial(optax.lion, 1.0),  # its weight decay reads the parameters
    "adagrad": partial(optax.adagrad, 1.0, initial_accumulator_value=1e-12),  # not zero at the start
}


def by_field():
    """Adam for the means, RMSprop for the other fields."""
    labels = Gaussians(*("means" if name == "means" else "rest" for name in ARRAYS))
    return optax.multi_transform({"means": optax.adam(1.0), "rest": optax.rmsprop(1.0)}, labels)


RULES["by field"] = by_field
# The gradient of a pixel's mean error is about as small as there are many pixels.
RATES = {"momentum": LearningRates(0.02, 0.002, 20.0, 1.0, 200.0, 20.0, 2.0)}


def numbered(state):
    """An optimizer state whose rows are 1, 2, 3 and so on, and whose other numbers are 5."""

    def leaf(x):
        rows = jnp.arange(1.0, len(x) + 1).reshape(-1, *[1] * (x.ndim - 1)) if x.ndim else 5
        return jnp.broadcast_to(rows, x.shape).astype(x.dtype)

    return jax.tree.map(leaf, state)


@pytest.mark.parametrize("name", RULES)
def test_the_state_of_a_rule_follows_the_gaussians_and_that_of_newborns_starts_anew(name):
    rule, old, new = RULES[name], random_gaussians(n=4), random_gaussians(n=6, seed=1)
    parents = np.array([3, 1, 1, 0, 0, 0])
    state = jax.tree.map(lambda leaf: leaf[parents] if leaf.ndim else leaf, numbered(rule().init(old)))
    newborn = jnp.array([False, False, True, False, True, True])
    moved = jax.tree.leaves(restarted(state, newborn, (), new, rule))
    rows = 0
    for leaf, start in zip(moved, jax.tree.leaves(rule().init(new)), strict=True):
        if leaf.ndim:
            assert_array_equal(leaf[jnp.array([0, 1, 3])].reshape(3, -1)[:, 0], [4, 2, 1])
            assert_array_equal(leaf[jnp.array([2, 4, 5])], start[jnp.array([2, 4, 5])])
            rows += 1
        else:
            assert leaf == 5  # a step count is not of the Gaussians
    assert rows >= len(ARRAYS)


@pytest.mark.parametrize("name", RULES)
def test_the_state_of_restarted_fields_starts_anew_and_no_other(name):
    rule, gaussians = RULES[name], random_gaussians(n=3)
    state, fresh = numbered(rule().init(gaussians)), rule().init(gaussians)
    now = restarted(state, jnp.zeros(3, bool), ("opacity_logits",), gaussians, rule)
    of_opacities = 0
    for (path, leaf), before, start in zip(
        jax.tree_util.tree_leaves_with_path(now),
        jax.tree.leaves(state),
        jax.tree.leaves(fresh),
        strict=True,
    ):
        of_opacity = "opacity_logits" in jax.tree_util.keystr(path)
        assert_array_equal(leaf, start if of_opacity else before)
        of_opacities += of_opacity
    assert of_opacities


@pytest.mark.parametrize("name", RULES)
def test_a_rule_trains_through_density_control(name):
    optimizer = Optimizer(RULES[name], RATES.get(name, LearningRates()))
    history = run(capture(), replace(RECIPE, optimizer=optimizer))
    losses = [loss for _, loss, _, _ in history]
    assert np.mean(losses[-10:]) < 0.9 * np.mean(losses[:10])
    assert history[-1][2] > history[0][2]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(history[-1][3].gaussians))


def test_weight_decay_leaves_empty_slots_empty():
    gaussians = pad(random_gaussians(n=3), 5)
    rule = partial(optax.adamw, 1.0, weight_decay=0.1)
    rates = LearningRates().at(jnp.float32(0), jnp.float32([1]), gaussians.sh.shape[1])
    gradients = jax.tree.map(jnp.zeros_like, gaussians)
    moved, _ = update(gaussians, gradients, rule().init(gaussians), rates, rule)
    assert np.all(np.isneginf(moved.opacity_logits[3:]))
    assert np.all(np.asarray(moved.opacity_logits[:3]) != np.asarray(gaussians.opacity_logits[:3]))


def test_one_step_of_adam_is_as_long_as_the_learning_rate():
    """The first step of Adam is the sign of the gradient, whatever its size."""
    gaussians = random_gaussians(n=3)
    rates = LearningRates().at(jnp.float32(0), jnp.float32([2]), gaussians.sh.shape[1])
    gradients = jax.tree.map(lambda leaf: jnp.full_like(leaf, -1e-7), gaussians)
    moved, _ = update(gaussians, gradients, Adam()().init(gaussians), rates, Adam())
    np.testing.assert_allclose(moved.means - gaussians.means, 2 * 1.6e-4, rtol=2e-3)  # float32 near 1
    np.testing.assert_allclose(moved.opacity_logits - gaussians.opacity_logits, 0.05, rtol=1e-4)
