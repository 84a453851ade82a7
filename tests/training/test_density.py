"""The decisions of the classic strategy on scenes for which they are known."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refined import refine as refined_by

from scenes import camera_at, random_gaussians
from splatax.math import quaternions
from splatax.rendering import project, render
from splatax.training.capacity import bucket_for, pad
from splatax.training.density import STRATEGIES, ByFactor, Classic, Mcmc
from splatax.training.density.classic import Observed
from splatax.training.protocols import DensityStrategy
from splatax.training.refining import Due

KEY = jax.random.key(0)
EXTENT = 10.0
EARLY, LATE = 600, 3100  # steps before and after the first opacity reset


def scene(sizes, opacities):
    """Round Gaussians of these sizes."""
    n = len(sizes)
    gaussians = random_gaussians(n=n)
    logits = np.log(np.array(opacities) / (1 - np.array(opacities)))
    return pad(
        replace(
            gaussians,
            log_scales=jnp.repeat(jnp.log(jnp.array(sizes, jnp.float32))[:, None], 3, axis=1),
            opacity_logits=jnp.asarray(logits, jnp.float32),
        ),
        bucket_for(n),
    )


def pulled(pull, screen=None, capacity=1024):
    """Observed in two views, with this mean pull."""
    pull = np.array(pull, np.float32)
    rows = (
        2 * pull,
        np.full_like(pull, 2),
        np.zeros_like(pull) if screen is None else np.array(screen, np.float32),
    )
    return Observed(*(jnp.asarray(np.pad(row, (0, capacity - len(row)))) for row in rows))


def refine(gaussians, state, count, step=EARLY, strategy=None):
    return refined_by(strategy or Classic(), state, gaussians, count, Due(step, EXTENT, KEY))


def test_nothing_happens_without_cause():
    gaussians = scene([0.05, 0.2], [0.5, 0.5])
    refined = refine(gaussians, pulled([1e-4, 1e-4]), 2)
    assert refined.count == 2
    for a, b in zip(jax.tree.leaves(refined.gaussians), jax.tree.leaves(gaussians), strict=True):
        assert_array_equal(a[:2], b[:2])
    assert_array_equal(refined.newborn[:2], False)


def test_small_is_cloned_in_place_and_keeps_its_moments_while_the_copy_has_none():
    refined = refine(scene([0.05, 0.05], [0.5, 0.5]), pulled([0, 3e-4]), 2)
    assert refined.count == 3
    assert_array_equal(refined.parents[:3], [0, 1, 1])
    assert_array_equal(refined.newborn[:3], [False, False, True])
    for leaf in jax.tree.leaves(refined.gaussians):
        assert_array_equal(leaf[2], leaf[1])


def test_large_is_replaced_by_two_smaller_drawn_from_it():
    n = 400
    gaussians = scene([0.5] * n, [0.5] * n)
    stretch = jnp.log(jnp.array([1.0, 0.5, 0.11]))
    gaussians = replace(gaussians, log_scales=gaussians.log_scales.at[:].set(stretch))
    refined = refine(gaussians, pulled([3e-4] * n), n)
    assert refined.count == 2 * n
    assert np.all(refined.newborn[: 2 * n])
    parent = np.asarray(refined.parents[: 2 * n])
    assert_array_equal(np.bincount(parent), 2)
    assert_allclose(
        refined.gaussians.log_scales[: 2 * n], jnp.tile(stretch - math.log(1.6), (2 * n, 1)), rtol=1e-5
    )
    # In the parent's own axes the offsets are normal with the parent's standard deviations.
    rotations = jax.vmap(quaternions.to_rotation)(gaussians.quats[parent])
    offsets = refined.gaussians.means[: 2 * n] - gaussians.means[parent]
    local = np.einsum("nij,ni->nj", rotations, offsets) / np.exp(stretch)
    assert_allclose(local.std(axis=0), 1, atol=0.1)
    assert_allclose(local.mean(axis=0), 0, atol=0.12)


def test_faint_is_pruned_and_nothing_comes_of_it():
    refined = refine(scene([0.05, 0.05, 0.5], [0.5, 0.004, 0.004]), pulled([0, 1, 1]), 3)
    assert refined.count == 1
    assert_array_equal(refined.parents[:1], [0])


def test_oversized_is_pruned_after_the_first_reset_alone():
    gaussians = scene([0.05, 1.1], [0.5, 0.5])
    assert refine(gaussians, pulled([0, 0]), 2, EARLY).count == 2
    assert refine(gaussians, pulled([0, 0]), 2, LATE).count == 1
    # 1.1 / 1.6 is within the limit: split, it may stay.
    assert refine(gaussians, pulled([0, 1]), 2, LATE).count == 3


def test_what_fills_the_screen_is_pruned_between_the_first_reset_and_a_limit():
    gaussians, state = scene([0.05, 0.05], [0.5, 0.5]), pulled([0, 0], screen=[0.1, 0.2])
    assert [refine(gaussians, state, 2, step).count for step in (EARLY, LATE, 4100)] == [2, 1, 2]


def test_growth_stops_at_the_limit_with_the_most_pulled_first():
    strategy = Classic(max_gaussians=6)
    refined = refine(scene([0.05] * 4, [0.5] * 4), pulled([3e-4, 9e-4, 4e-4, 8e-4]), 4, strategy=strategy)
    assert refined.count == 6
    assert_array_equal(refined.parents[:6], [0, 1, 2, 3, 1, 3])


def test_opacity_reset_lowers_what_is_above_and_restarts_its_moments_alone():
    gaussians = scene([0.05, 0.05], [0.5, 0.008])
    strategy = Classic(every=7_000)
    refined = refine(gaussians, pulled([1, 1]), 2, step=3_000, strategy=strategy)
    assert refined.count == 2
    assert_allclose(refined.gaussians.opacities[:2], [0.01, 0.008], rtol=1e-5)
    assert np.all(np.isneginf(refined.gaussians.opacity_logits[2:]))
    assert refined.restarted == ("opacity_logits",)


@pytest.mark.parametrize(
    ("step", "due"), [(400, False), (500, False), (600, True), (650, False), (3000, True), (15_000, False)]
)
def test_refinement_is_due_every_hundredth_step_between_start_and_end(step, due):
    assert Classic().due(step) is due


def test_pull_is_the_gradient_with_the_image_from_minus_one_to_one():
    gaussians, camera = random_gaussians(n=30, spread=3.0), camera_at(size=(32, 24))
    splats = project(gaussians, camera)
    d_splats = replace(splats, means2d=jnp.full_like(splats.means2d, 0.5))
    strategy = Classic()
    state = strategy.observe(strategy.observe(strategy.init(30), splats, d_splats), splats, d_splats)
    visible = np.asarray(splats.extents > 0).any(axis=1)
    assert 0 < visible.sum() < 30
    assert_allclose(state.pull, np.where(visible, 2 * np.hypot(0.5 * 16, 0.5 * 12), 0), rtol=1e-6)
    assert_array_equal(state.views, np.where(visible, 2, 0))
    assert_allclose(state.screen, np.asarray(splats.extents).max(axis=1) / 32, rtol=1e-6)


def test_absolute_pull_is_asked_for_and_read():
    splats = project(random_gaussians(n=30), camera_at(size=(32, 24)))
    assert Classic().watch(splats).pull is None
    strategy = Classic(absolute=True)
    watched = strategy.watch(splats)
    assert_array_equal(watched.pull, np.zeros((30, 2)))
    d_splats = replace(watched, means2d=jnp.zeros((30, 2)), pull=jnp.full((30, 2), 0.5))
    state = strategy.observe(strategy.init(30), watched, d_splats)
    visible = np.asarray(splats.extents > 0).any(axis=1)
    assert_allclose(state.pull, np.where(visible, np.hypot(0.5 * 16, 0.5 * 12), 0), rtol=1e-6)


# --- the contract of every strategy ---


@pytest.mark.parametrize("strategy", [cls() for cls in STRATEGIES.values()], ids=STRATEGIES.keys())
def test_strategies_are_values_that_the_trainer_can_hold(strategy):
    assert isinstance(strategy, DensityStrategy)
    assert hash(strategy) == hash(type(strategy)())


@pytest.mark.parametrize(
    ("strategy", "state"), [(Classic(), pulled([1, 1, 0])), (Mcmc(growth=ByFactor(2.0)), ())]
)
def test_refinement_depends_on_nothing_but_its_arguments(strategy, state):
    gaussians = scene([0.05, 0.5, 0.2], [0.5, 0.5, 0.004])
    first, second = (refine(gaussians, state, 3, strategy=strategy) for _ in range(2))
    for a, b in zip(jax.tree.leaves(first.gaussians), jax.tree.leaves(second.gaussians), strict=True):
        assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("strategy", "state"), [(Classic(), pulled([1, 1, 0])), (Mcmc(growth=ByFactor(2.0)), ())]
)
def test_a_refined_scene_is_the_living_first_and_then_empty_slots(strategy, state):
    refined = refine(scene([0.05, 0.5, 0.2], [0.5, 0.5, 0.004]), state, 3, strategy=strategy)
    living = np.arange(len(refined.gaussians)) < refined.count
    assert_array_equal(np.isfinite(refined.gaussians.opacity_logits), living)
    assert len(refined.parents) == len(refined.newborn) == refined.count
    for leaf in jax.tree.leaves(refined.kept.opt_state):
        assert_array_equal(leaf[refined.count :] if leaf.ndim else 0, 0)


# --- capacity ---


def test_capacity_doubles_up_to_what_will_ever_be_needed():
    assert [bucket_for(n) for n in (1, 1024, 1025, 100_000)] == [1024, 1024, 2048, 131_072]
    assert bucket_for(10, current=5000) == 5000
    assert [bucket_for(n, 1024, 3000) for n in (1000, 1025, 2049)] == [1024, 2048, 3000]
    assert bucket_for(5000, 1024, 3000) == 8192  # more than expected


def test_capacity_changes_nothing_in_the_image():
    gaussians, camera = random_gaussians(), camera_at()
    image = render(gaussians, camera).rgb
    assert_allclose(
        render(pad(gaussians, 1024), camera).rgb, image, atol=3e-7
    )  # vector lanes round otherwise
