"""A step of the rows is Adam as NumPy and optax compute it, with the prior and the noise of the recipe."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from enrolled import kernels
from numpy.testing import assert_allclose, assert_array_equal

import emulated
from scenes import random_gaussians
from splatax import backends
from splatax.backends import cpu
from splatax.gaussians import ARRAYS, Gaussians
from splatax.math import quaternions
from splatax.moving import FADED, NOISELESS, Moments, Rule, Step, corrections, normals
from splatax.training.capacity import pad
from splatax.training.moving import rule_of
from splatax.training.noise import Langevin
from splatax.training.optimizer import LearningRates, free_coefficients
from splatax.training.priors import Sparsity
from splatax.training.recipes import PRESETS

N, LIVING, EXTENT = 75, 70, 3.0  # not a multiple of the sixteen rows that native code takes at once
ADAM = Rule(0.9, 0.999, 1e-15)
FULL = replace(ADAM, opacity=0.3, scale=0.7, noise=5e5)
KEY = jax.random.key(5)
MOVING = ["xla", "cuda", emulated.NAME, "cpu-avx512", "cpu-avx2", "cpu-baseline"]


@pytest.fixture(params=MOVING)
def move(request):
    return jax.jit(kernels(request.param).move, static_argnames=("rule", "block"))


def scene(rows=N, seed=0):
    """A scene with empty slots at its end, of Gaussians of all opacities."""
    gaussians = random_gaussians(n=min(rows, LIVING), degree=2, seed=seed)
    logits = jnp.asarray(np.random.default_rng(seed).uniform(-8, 3, len(gaussians)), jnp.float32)
    return pad(replace(gaussians, opacity_logits=logits), rows)


def like(gaussians, seed, size=1e-3):
    """Random numbers in the shape of a scene, zero in empty slots."""
    rng = np.random.default_rng(seed)
    leaves = {}
    for name in ARRAYS:
        leaf = np.array(getattr(gaussians, name))
        values = rng.normal(0, size, leaf.shape).astype(np.float32)
        values[min(LIVING, len(values)) :] = 0
        leaves[name] = jnp.asarray(values)
    return Gaussians(**leaves)


def moments_like(gaussians, seed=7):
    mean = like(gaussians, seed)
    return Moments(mean, jax.tree.map(jnp.square, like(gaussians, seed + 1)))


def step(gaussians, *, count=3, good=True, keys=KEY[None], each=True):
    """The numbers of a step; band 2 is not learned yet."""
    n, k = len(gaussians), gaussians.sh.shape[1]
    reach = jnp.linspace(1.0, 2.0, n, dtype=jnp.float32) if each else jnp.ones(1)
    progress = jnp.float32(0.5)
    return Step(
        rates=LearningRates().at(progress, reach, k),
        free=free_coefficients(progress, jnp.array([0, 0.2, 0.7, 1, 1], jnp.float32), k),
        good=jnp.asarray(good),
        steps=jnp.int32(count),
        living=jnp.int32(min(n, LIVING)),
        extent=jnp.float32(EXTENT),
        keys=jax.random.key_data(keys),
    )


def adam_of_numpy(gaussians, gradients, moments, at, rule):
    """Adam with one rounding in each operation, as splatax/moving.py writes it."""

    def number(value):
        return np.float32(value)

    def flushed(value):
        return np.where(np.abs(value) < np.finfo(np.float32).tiny, np.float32(0), value)

    by_mean, by_square = map(np.float32, jax.jit(corrections, static_argnames="rule")(at, rule=rule))
    found = {}
    for name in ARRAYS:
        x, g, m, v, rate = (
            np.asarray(getattr(part, name)) for part in (gaussians, gradients, *moments, at.rates)
        )
        if name == "sh":
            g = np.where(np.asarray(at.free)[None, :, None], g, number(0))
        m = flushed(number(rule.b1) * m) + flushed(number(1 - rule.b1) * g)
        v = flushed(number(rule.b2) * v) + flushed(number(1 - rule.b2) * flushed(g * g))
        found[name] = (x - rate * (m * by_mean / (np.sqrt(v * by_square) + number(rule.eps))), m, v)
    q = found["quats"][0]
    squared = ((q[:, 0] ** 2 + q[:, 1] ** 2) + q[:, 2] ** 2) + q[:, 3] ** 2
    changed = np.any(q != np.asarray(gaussians.quats), axis=1)
    lengths = np.sqrt(np.where(changed, squared, number(1)))
    q = np.where(changed[:, None], q / lengths[:, None], q)
    found["quats"] = (q, *found["quats"][1:])
    return [found[name][part] for part in range(3) for name in ARRAYS]


def assert_moved_alike(found, expected, tolerance):
    for name, a, b in zip(ARRAYS * 3, jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(a, b, err_msg=name, **tolerance)


@pytest.mark.parametrize("each", [True, False], ids=["a rate for each row", "one rate"])
def test_moves_as_numpy_does_and_native_code_to_the_bit(move, request, each):
    gaussians = scene()
    gradients, moments, at = like(gaussians, 1), moments_like(gaussians), step(gaussians, each=each)
    found = jax.tree.leaves(move(gaussians, gradients, moments, at, rule=ADAM, block=N))
    expected = adam_of_numpy(gaussians, gradients, moments, at, ADAM)
    for name, a, b in zip(ARRAYS * 3, found, expected, strict=True):
        if "xla" not in request.node.name:
            assert_array_equal(a, b, err_msg=name)
        else:
            assert_allclose(a, b, rtol=2e-6, atol=1e-7, err_msg=name)


def test_moves_as_optax_with_the_gradient_of_the_penalty(move):
    gaussians = scene()
    gradients, moments, at = like(gaussians, 1), moments_like(gaussians), step(gaussians)
    rule = replace(FULL, noise=0.0)
    with jax.numpy_dtype_promotion("standard"):
        prior = jax.grad(Sparsity(rule.opacity, rule.scale))(gaussians, at.extent, at.living)
        whole = jax.tree.map(jnp.add, gradients, prior)
        whole = replace(whole, sh=jnp.where(at.free[None, :, None], whole.sh, 0))
        state = optax.ScaleByAdamState(at.steps - 1, moments.mean, moments.square)
        updates, state = optax.scale_by_adam(rule.b1, rule.b2, rule.eps).update(whole, state)
    expected = jax.tree.map(lambda x, rate, by: x - rate * by, gaussians, at.rates, updates)
    quats = jax.vmap(quaternions.normalize)(expected.quats)
    changed = jnp.any(expected.quats != gaussians.quats, axis=1, keepdims=True)
    expected = replace(expected, quats=jnp.where(changed, quats, gaussians.quats))
    found = move(gaussians, gradients, moments, at, rule=rule, block=N)
    # Kernels round exp to 1e-6, and the prior is as large as the gradient.
    assert_moved_alike(found, (expected, state.mu, state.nu), {"rtol": 2e-5, "atol": 1e-7})


def test_noise_is_that_of_the_portable_backend(move):
    gaussians = scene(rows=200)
    gradients, moments, at = like(gaussians, 1), moments_like(gaussians), step(gaussians)
    still = move(gaussians, gradients, moments, at, rule=ADAM, block=200)[0]
    found = move(gaussians, gradients, moments, at, rule=replace(ADAM, noise=5e5), block=200)[0]
    expected = Langevin(5e5)(still, at.rates.means[:, 0], at.extent, KEY)
    shift = np.asarray(expected.means - still.means)
    faint = np.asarray(still.opacities) < NOISELESS
    assert np.abs(shift[faint]).max() > 1e-4
    assert_allclose(found.means - still.means, shift, atol=3e-6 * np.abs(shift).max() + 1e-6)
    assert_array_equal(found.means[~faint], still.means[~faint])


def test_the_deviates_of_blocks_are_those_of_jax():
    keys = jax.random.split(KEY, 3)
    drawn = normals(jax.random.key_data(keys), 70, 32, jnp.float32)
    expected = np.concatenate([np.asarray(jax.random.normal(key, (32, 3))) for key in keys])
    assert_array_equal(drawn, expected[:70])


def test_a_step_that_is_not_good_moves_nothing(move):
    gaussians = scene()
    gradients = jax.tree.map(lambda leaf: leaf.at[0].set(jnp.nan), like(gaussians, 1))
    moments = moments_like(gaussians)
    after, _ = move(gaussians, gradients, moments, step(gaussians, good=False), rule=FULL, block=N)
    for name in ARRAYS:
        assert_array_equal(getattr(after, name), getattr(gaussians, name), err_msg=name)


def test_rows_that_rest_keep_their_bits_and_empty_slots_stay_empty(move):
    gaussians = scene()
    gradients = jax.tree.map(lambda leaf: leaf.at[16:40].set(0), like(gaussians, 1))
    nothing = jax.tree.map(jnp.zeros_like, gaussians)
    moved, moments = move(
        gaussians, gradients, Moments(nothing, nothing), step(gaussians, count=1), rule=ADAM, block=N
    )
    for name in ARRAYS:
        before, after = np.asarray(getattr(gaussians, name)), np.asarray(getattr(moved, name))
        assert_array_equal(after[16:40], before[16:40], err_msg=name)
        assert_array_equal(after[LIVING:], before[LIVING:], err_msg=name)
        assert np.any(after[:16] != before[:16], axis=tuple(range(1, after.ndim))).all(), name
        for part in moments:
            assert not np.any(np.asarray(getattr(part, name))[16:40])


def test_a_number_without_gradient_and_mean_keeps_its_square(move):
    gaussians = scene()
    gradients = jax.tree.map(lambda leaf: leaf.at[16:40].set(0), like(gaussians, 1))
    moments = moments_like(gaussians)
    moments = moments._replace(mean=jax.tree.map(lambda leaf: leaf.at[16:40].set(0), moments.mean))
    moved, after = move(gaussians, gradients, moments, step(gaussians), rule=ADAM, block=N)
    for name in ARRAYS:
        known, square = np.asarray(getattr(moments.square, name)), np.asarray(getattr(after.square, name))
        assert_array_equal(square[16:40], known[16:40], err_msg=name)
        assert np.any(square[:16] != known[:16]), name
        assert_array_equal(getattr(moved, name)[16:40], getattr(gaussians, name)[16:40], err_msg=name)


def test_a_gaussian_without_gradient_whose_centre_has_no_mean_rests_until_a_gradient_wakes_it(move):
    gaussians, moments = scene(), moments_like(scene())
    still = replace(moments.mean, means=moments.mean.means.at[16:40].set(0))
    gradients = jax.tree.map(lambda leaf: leaf.at[16:40].set(0), like(gaussians, 1))
    gradients = replace(gradients, sh=gradients.sh.at[30, 1, 2].set(1e-3).at[31, 6].set(1e-3))
    moved, after = move(
        gaussians,
        gradients,
        Moments(still, moments.square),
        step(gaussians),
        rule=replace(FULL, noise=0.0),
        block=N,
    )
    asleep = [*range(16, 30), *range(31, 40)]  # in row 31, a band that is not learned yet has a gradient
    for name in ("means", "quats", "sh"):
        found = [getattr(part, name) for part in (moved, *after)]
        known = [getattr(part, name) for part in (gaussians, still, moments.square)]
        for a, b in zip(found, known, strict=True):
            assert_array_equal(np.asarray(a)[asleep], np.asarray(b)[asleep], err_msg=name)
            if name != "means":
                assert np.any(np.asarray(a)[30] != np.asarray(b)[30]), name
    for name in ("log_scales", "opacity_logits"):  # which the prior moves
        assert np.all(getattr(moved, name)[16:40] != getattr(gaussians, name)[16:40]), name


def test_a_mean_that_hardly_moves_its_number_and_has_no_gradient_becomes_zero(move):
    gaussians, at = scene(), step(scene())
    nothing = jax.tree.map(jnp.zeros_like, gaussians)
    by_mean, by_square = corrections(at, ADAM)
    square = jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e-6), gaussians)
    one = jnp.sqrt(1e-6 * ADAM.b2 * by_square) / (ADAM.b1 * by_mean)  # of means for a step of one rate
    ways = jnp.where(jnp.arange(N) % 2 == 0, 0.9 * FADED, 1.1 * FADED)
    mean = jax.tree.map(
        lambda leaf: jnp.broadcast_to((one * ways).reshape(-1, *[1] * (leaf.ndim - 1)), leaf.shape), gaussians
    )
    moved, after = move(gaussians, nothing, Moments(mean, square), at, rule=ADAM, block=N)
    for name in ARRAYS:
        left = np.asarray(getattr(after.mean, name))
        assert not left[::2].any(), name
        assert left[1::2].all(), name
        if name != "quats":  # whose row may be normalized
            assert_array_equal(getattr(moved, name)[::2], getattr(gaussians, name)[::2], err_msg=name)


def test_a_row_depends_on_itself_alone():
    """Rows in another order of blocks, as other devices own them, and on one thread, have the same bits."""
    if backends.why_unavailable("cpu") is not None:
        pytest.skip("only the native backend computes each row alone")
    gaussians = scene(rows=96)
    gaussians = replace(gaussians, opacity_logits=jnp.linspace(-8, 3, 96, dtype=jnp.float32))
    gradients, moments = like(gaussians, 1), moments_like(gaussians)
    keys = jax.random.split(KEY, 3)
    at = step(gaussians, keys=keys)
    whole = cpu.BEST.move(gaussians, gradients, moments, at, FULL, 32)
    alone = cpu.kernels(threads=1).move(gaussians, gradients, moments, at, FULL, 32)
    for a, b in zip(*map(jax.tree.leaves, (whole, alone)), strict=True):
        assert_array_equal(a, b)
    for block in range(3):
        own = slice(32 * block, 32 * block + 32)
        rows = jax.tree.map(lambda leaf, own=own: leaf[own], (gaussians, gradients, moments))
        rates = replace(at.rates, means=at.rates.means[own])
        part = cpu.BEST.move(*rows, at._replace(rates=rates, keys=at.keys[block : block + 1]), FULL, 32)
        for a, b in zip(*map(jax.tree.leaves, (whole, part)), strict=True):
            assert_array_equal(a[own], b)


def test_moments_that_nobody_feeds_end_at_zero():
    """Not at numbers so small that processors are slow with them, whatever a thread is told of them."""
    if backends.why_unavailable("cpu") is not None:
        pytest.skip("numbers below 2^-126 count as zero in native code")
    gaussians = scene()
    nothing = jax.tree.map(jnp.zeros_like, gaussians)
    tiny = jax.tree.map(lambda leaf: jnp.full_like(leaf, 1.25e-38), gaussians)
    moved, moments = cpu.BEST.move(gaussians, nothing, Moments(tiny, tiny), step(gaussians), ADAM, N)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(moments.mean))
    assert_allclose(moved.means, gaussians.means, atol=1e-6)


@pytest.mark.parametrize(
    "settings", [(1.0, 0.9, 1e-8), (0.9, -0.1, 1e-8), (0.9, 0.9, 0.0), (np.nan, 0.9, 1e-8)]
)
def test_a_rule_with_impossible_numbers_is_refused(settings):
    with pytest.raises(ValueError, match=r"must be (finite|in \[0, 1\))"):
        Rule(*settings)


def test_arrays_of_a_step_that_do_not_fit_are_refused(move):
    gaussians = scene()
    gradients, moments, at = like(gaussians, 1), moments_like(gaussians), step(gaussians)
    short = jax.tree.map(lambda leaf: leaf[1:], gradients)
    with pytest.raises(ValueError, match="gradient of sh has shape"):
        move(gaussians, short, moments, at, rule=ADAM, block=N)
    with pytest.raises(ValueError, match=r"keys are uint32\[1, 2\], not uint32\[2, 2\]"):
        move(gaussians, gradients, moments, at, rule=ADAM, block=64)
    with pytest.raises(ValueError, match="must be a multiple of 16"):
        move(gaussians, gradients, moments, at, rule=ADAM, block=20)


def test_kernels_move_the_presets_and_optax_what_they_do_not_know():
    for preset in PRESETS.values():
        assert rule_of(preset.build(100)) is not None
    recipe = PRESETS["default"].build(100)
    other = replace(recipe, optimizer=replace(recipe.optimizer, rule=optax.rmsprop))
    assert rule_of(other) is None
