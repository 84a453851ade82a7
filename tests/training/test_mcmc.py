"""Relocation and growth preserve the image, noise has its covariance, and priors have their gradient."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refined import refine as refined_by

from scenes import camera_at, random_gaussians, with_slots
from splatax.rendering import render
from splatax.training.capacity import pad
from splatax.training.density.growth import ByFactor, ByStep
from splatax.training.density.mcmc import MAX_COPIES, Mcmc, in_proportion, relocated
from splatax.training.noise import Langevin, NoNoise
from splatax.training.priors import NoPrior, Sparsity
from splatax.training.refining import Due

KEY = jax.random.key(0)
NO_GROWTH = Mcmc(growth=ByFactor(1.0))


def refine(gaussians, count, strategy=NO_GROWTH, step=600, key=KEY):
    return refined_by(strategy, (), gaussians, count, Due(step, 1.0, key))


# --- what N Gaussians in the place of one look like ---


@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("copies", [1, 2, 7, MAX_COPIES])
def test_copies_over_each_other_cover_what_one_did(opacity, copies):
    part, factor = (float(x[0]) for x in relocated(np.array([opacity]), np.array([copies])))
    x = np.linspace(-60, 60, 200_001)
    one = opacity * np.exp(-(x**2) / 2)
    many = 1 - (1 - part * np.exp(-((x / factor) ** 2) / 2)) ** copies
    assert_allclose(many.max(), opacity, rtol=1e-9)
    assert_allclose(np.trapezoid(many, x), np.trapezoid(one, x), rtol=1e-7)


def test_the_factor_is_that_of_the_paper():
    opacity, copies = 0.8, 5
    part = 1 - (1 - opacity) ** (1 / copies)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * part ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    assert_allclose(relocated(np.array([opacity]), np.array([copies]))[1], opacity / total, rtol=1e-12)


def test_relocation_leaves_the_picture():
    opacities = np.tile([0.3, 0.6, 0.9, 0.001], 30)  # a quarter is dead, and too faint to be seen
    gaussians, camera = with_slots(opacities, degree=0), camera_at()
    before = np.asarray(render(gaussians, camera).rgb)
    refined = refine(gaussians, 120)
    change = np.abs(np.asarray(render(refined.gaussians, camera).rgb) - before)
    copied = jax.tree.map(lambda leaf: leaf[refined.parents], gaussians)
    naive = np.abs(np.asarray(render(copied, camera).rgb) - before)
    assert before.max() > 0.5
    assert change.mean() < 0.01
    assert change.mean() < 0.25 * naive.mean()


# --- who goes where, and how many there are ---


def test_the_dead_go_where_the_living_are_and_all_concerned_lose_their_moments():
    opacities = [0.5, 0.004, 0.9, 0.0049, 0.7]
    refined = refine(with_slots(opacities), 5)
    parent, newborn = np.asarray(refined.parents), np.asarray(refined.newborn)
    assert refined.count == 5
    assert_array_equal(parent[[0, 2, 4]], [0, 2, 4])
    sources = set(parent[[1, 3]])
    assert sources <= {0, 2, 4}
    assert_array_equal(newborn[:5], [row in sources | {1, 3} for row in range(5)])
    for leaf in (refined.gaussians.means, refined.gaussians.log_scales, refined.gaussians.opacity_logits):
        assert_array_equal(leaf[1], leaf[parent[1]])


def test_the_untouched_and_the_empty_stay_as_they_are():
    gaussians = with_slots([0.5, 0.004, 0.9, 0.8])
    refined = refine(gaussians, 4)
    rest = np.flatnonzero(~np.asarray(refined.newborn[:4]))
    assert len(rest) == 2
    for a, b in zip(jax.tree.leaves(refined.gaussians), jax.tree.leaves(gaussians), strict=True):
        assert_array_equal(a[rest], b[rest])
    assert np.all(np.isneginf(refined.gaussians.opacity_logits[4:]))


def test_a_scene_without_life_is_left_alone():
    gaussians = with_slots([0.001, 0.002])
    refined = refine(gaussians, 2)
    assert refined.count == 2
    assert_array_equal(refined.gaussians.means, gaussians.means)


def test_places_are_drawn_in_proportion_to_opacity():
    weights = np.array([0.1, 0.0, 0.4, 0.3, 0.2, 0.0])
    draws = np.concatenate([in_proportion(weights, 7, jax.random.key(i)) for i in range(1000)])
    assert_allclose(np.bincount(draws, minlength=6) / 7000, weights, atol=0.01)


def test_growth_by_factor_stops_at_the_most():
    strategy = Mcmc(growth=ByFactor(1.5), max_gaussians=40)
    gaussians, counts = with_slots([0.5] * 20), [20]
    for _ in range(3):
        refined = refine(gaussians, counts[-1], strategy)
        gaussians, counts = refined.gaussians, [*counts, refined.count]
    assert counts == [20, 30, 40, 40]
    assert_array_equal(np.isfinite(gaussians.opacity_logits), np.arange(1024) < 40)


def test_growth_by_step_reaches_the_most_by_equal_factors():
    growth, counts = ByStep(full=500), [1000]
    for step in range(100, 800, 100):
        counts.append(growth.after(counts[-1], step, 100, 32_000))
    assert_allclose(counts[:6], 1000 * 2.0 ** np.arange(6), rtol=0.002)
    assert counts[5:] == [32_000] * 3


def test_more_points_than_the_most_are_kept():
    assert refine(with_slots([0.5] * 20), 20, Mcmc(max_gaussians=10)).count == 20


def test_another_key_takes_other_places():
    gaussians = with_slots([0.5] * 50 + [0.001] * 10)
    parents = [np.asarray(refine(gaussians, 60, key=jax.random.key(i)).parents) for i in (0, 0, 1)]
    assert_array_equal(parents[0], parents[1])
    assert np.any(parents[0] != parents[2])


@pytest.mark.parametrize(("step", "due"), [(500, False), (600, True), (650, False), (25_000, False)])
def test_refinement_is_due_between_start_and_end(step, due):
    assert Mcmc().due(step) is due


# --- noise ---


def many_faint(n=40_000, opacity=0.001):
    """Copies of one Gaussian."""
    one = random_gaussians(n=1, degree=0)
    gaussians = jax.tree.map(lambda leaf: jnp.repeat(leaf, n, axis=0), one)
    return replace(gaussians, opacity_logits=jnp.full(n, math.log(opacity / (1 - opacity)), jnp.float32))


def test_noise_has_no_mean_and_the_square_of_the_covariance():
    gaussians = many_faint()
    extent, rate, strength = 2.0, 1e-3, 1e4
    shaken = Langevin(strength)(gaussians, jnp.float32([rate]), jnp.float32(extent), KEY)
    shift = np.asarray(shaken.means - gaussians.means, np.float64)
    gate = 1 / (1 + math.exp(100 * (0.001 - 0.005)))
    factor = strength * rate * gate * np.asarray(gaussians.covariances[0], np.float64) / extent**2
    expected = factor @ factor.T
    # 40,000 samples: standard errors of 1/200 in the mean, and of 1/140 in each variance.
    assert_allclose(shift.mean(axis=0) / np.sqrt(np.diag(expected)), 0, atol=0.02)
    assert_allclose(np.cov(shift.T), expected, atol=0.03 * np.abs(expected).max())


def test_noise_is_for_the_faint_alone_and_leaves_empty_slots():
    gaussians = pad(many_faint(n=2, opacity=0.2), 4)
    shaken = Langevin(1e9)(gaussians, jnp.float32([1e-3]), jnp.float32(1.0), KEY)
    assert_allclose(shaken.means[:2], gaussians.means[:2], atol=0.01)  # the gate is at 3e-9
    assert_array_equal(shaken.means[2:], gaussians.means[2:])


def test_noise_grows_with_the_world():
    small, k = many_faint(n=100), 10.0
    large = replace(small, means=small.means * k, log_scales=small.log_scales + math.log(k))
    shifts = [
        np.asarray(Langevin()(g, jnp.float32([1e-4 * size]), jnp.float32(size), KEY).means - g.means)
        for g, size in ((small, 1.0), (large, k))
    ]
    assert_allclose(shifts[1], k * shifts[0], rtol=1e-3, atol=1e-4)


def test_no_noise_is_no_noise():
    gaussians = many_faint(n=3)
    assert NoNoise()(gaussians, jnp.float32([1]), jnp.float32(1), KEY) is gaussians


# --- priors ---


def test_sparsity_is_the_mean_over_the_living():
    gaussians = random_gaussians(n=10)
    expected = 0.01 * np.mean(gaussians.opacities) + 0.01 * np.mean(gaussians.scales) / 3.0
    assert_allclose(Sparsity()(pad(gaussians, 64), jnp.float32(3.0), jnp.int32(10)), expected, rtol=1e-5)


def test_gradient_of_sparsity_is_that_of_finite_differences(x64):
    gaussians, prior = random_gaussians(n=5, dtype=np.float64), Sparsity(opacity=0.3, scale=0.7)
    gradient = jax.grad(prior)(gaussians, jnp.float64(2.0), jnp.int32(5))
    for name, step in (("opacity_logits", 1e-5), ("log_scales", 1e-5)):
        field = getattr(gaussians, name)
        for index in np.ndindex(field.shape):
            sides = [
                prior(replace(gaussians, **{name: field.at[index].add(s)}), jnp.float64(2.0), jnp.int32(5))
                for s in (step, -step)
            ]
            assert_allclose(getattr(gradient, name)[index], (sides[0] - sides[1]) / (2 * step), rtol=1e-6)
    assert not np.any(gradient.means)
    assert not np.any(gradient.sh)


def test_no_gradient_of_a_prior_reaches_empty_slots():
    gradient = jax.grad(Sparsity())(pad(random_gaussians(n=3), 8), jnp.float32(1.0), jnp.int32(3))
    for leaf in jax.tree.leaves(gradient):
        assert_array_equal(leaf[3:], 0)
    assert np.all(np.asarray(gradient.opacity_logits[:3]) > 0)
    assert NoPrior()(pad(random_gaussians(n=3), 8), jnp.float32(1.0), jnp.int32(3)) == 0
