"""A kernel that finds the gradient of a view and moves the scene does what the two kernels do, to the bit."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scenes import random_gaussians
from splatax import backends
from splatax.backends import cpu
from splatax.backends.protocol import PulledView
from splatax.cameras import Camera, RollingShutter
from splatax.cameras.lenses import opencv
from splatax.low_pass import Antialiasing, Dilation
from splatax.moving import Moments, Rule, Step
from splatax.training.optimizer import LearningRates, free_coefficients

ROWS = 700  # more than the 256 rows whose gradients are kept at a time
RULE = Rule(0.9, 0.999, 1e-15, opacity=0.3, scale=0.7, noise=5e5)
NATIVE = ["cpu-avx512", "cpu-avx2", "cpu-baseline"]


@pytest.fixture(params=NATIVE)
def kernels(request):
    reason = backends.why_unavailable(request.param)
    if reason is not None:
        pytest.skip(reason)
    return backends.resolve(request.param)


def scene(seen, rows=ROWS, seed=0):
    """Gaussians of which a fraction is in front of the camera, in no order; the rest is far to its side."""
    gaussians = random_gaussians(n=rows, degree=2, seed=seed)
    away = np.random.default_rng(seed).uniform(size=rows) > seen
    return replace(gaussians, means=jnp.where(away[:, None], gaussians.means + 1e3, gaussians.means))


def camera(lens=None):
    view = Camera.simple_pinhole(60.0, jnp.eye(4).at[2, 3].set(4.0), 80, 60)
    return view if lens is None else replace(view, lens=lens)


def moving(gaussians, good=True):
    """Moments of some rows, and the numbers of a step."""
    rng = np.random.default_rng(3)
    rows = rng.uniform(size=len(gaussians)) < 0.5

    def some(leaf, size):
        values = rng.normal(0, size, leaf.shape).astype(np.float32)
        return jnp.asarray(values * rows.reshape(-1, *[1] * (leaf.ndim - 1)))

    mean = jax.tree.map(lambda leaf: some(leaf, 1e-3), gaussians)
    square = jax.tree.map(lambda leaf: jnp.square(some(leaf, 1e-3)), gaussians)
    progress, k = jnp.float32(0.5), gaussians.sh.shape[1]
    step = Step(
        rates=LearningRates().at(progress, jnp.ones(1), k),
        free=free_coefficients(progress, jnp.array([0, 0.2, 0.7, 1, 1], jnp.float32), k),
        good=jnp.asarray(good),
        steps=jnp.int32(3),
        living=jnp.int32(len(gaussians)),
        extent=jnp.float32(2.0),
        keys=jax.random.key_data(jax.random.key(5))[None],
    )
    return Moments(mean, square), step


@partial(jax.jit, static_argnames=("kernels", "low_pass", "good"))
def both_ways(kernels, gaussians, view, low_pass, good=True):
    """The moved scene, its moments and the camera's gradient: at once, and by one kernel after the other."""
    moments, step = moving(gaussians, good)
    splats, pull_back = jax.vjp(partial(kernels.project, low_pass=low_pass), gaussians, view)
    rng = np.random.default_rng(4)
    d_splats = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0, 1e-2, leaf.shape), jnp.float32), splats)
    d_gaussians, d_camera = pull_back(d_splats)
    two = (*kernels.move(gaussians, d_gaussians, moments, step, RULE, ROWS), d_camera)
    seen = PulledView(view, low_pass, splats, d_splats)
    one = kernels.moved_at_once(view, low_pass)(gaussians, seen, moments, step, RULE, ROWS)
    return one, two, splats


@pytest.mark.parametrize("low_pass", [Dilation(), Antialiasing()], ids=["dilation", "antialiasing"])
@pytest.mark.parametrize("seen", [0.0, 0.1, 1.0])
def test_moves_as_the_gradient_and_the_move_one_after_the_other(kernels, seen, low_pass):
    one, two, splats = both_ways(kernels, scene(seen), camera(opencv(-0.1, 0.02)), low_pass)
    shown = np.mean(np.asarray(splats.extents)[:, 0] > 0)
    assert shown == 0 if seen == 0 else 0.3 * seen < shown <= seen
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert_array_equal(a, b)


def test_a_step_that_is_not_good_moves_nothing_although_gradients_are_not_finite(kernels):
    gaussians = scene(0.5)
    (moved, *_), *_ = both_ways(kernels, gaussians, camera(), Dilation(), good=False)
    for a, b in zip(jax.tree.leaves(moved)[:3], jax.tree.leaves(gaussians)[:3], strict=True):
        assert_array_equal(a, b)


def test_the_number_of_threads_changes_no_bit():
    if backends.why_unavailable("cpu") is not None:
        pytest.skip("there is no native library")
    gaussians = scene(0.3, rows=9000)
    moments, step = moving(gaussians)
    found = []
    for kernels in (cpu.kernels(threads=1), cpu.kernels()):
        splats = kernels.project(gaussians, camera(), Dilation())
        view = PulledView(camera(), Dilation(), splats, replace(splats, extents=splats.extents * 0))
        found.append(
            kernels.moved_at_once(camera(), Dilation())(gaussians, view, moments, step, RULE, len(gaussians))
        )
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        assert_array_equal(a, b)


def test_it_serves_no_camera_that_the_native_projection_does_not(kernels):
    still = camera()
    assert kernels.moved_at_once(still, Dilation()) is kernels.pull_and_move
    assert kernels.moved_at_once(still.on_canvas(100, 80), Dilation()) is kernels.pull_and_move
    moving = replace(still, motion=RollingShutter(jnp.zeros(6)))
    assert kernels.moved_at_once(moving, Dilation()) is None
    mine = replace(kernels, move=partial(kernels.move))
    assert mine.moved_at_once(still, Dilation()) is None, "a move of one's own must not be passed over"


@pytest.mark.parametrize("seen", [0.1, 0.5, 1.0])
def test_splats_do_not_depend_on_the_rows_around_them(kernels, seen):
    gaussians = scene(seen)
    order = np.random.default_rng(1).permutation(ROWS)
    splats = kernels.project(gaussians, camera(), Dilation())
    turned = kernels.project(jax.tree.map(lambda leaf: leaf[order], gaussians), camera(), Dilation())
    for a, b in zip(jax.tree.leaves(splats), jax.tree.leaves(turned), strict=True):
        assert_array_equal(a[order], b)


def test_a_colour_that_is_not_finite_culls_its_own_row_alone(kernels):
    gaussians = scene(0.2)
    whole = kernels.project(gaussians, camera(), Dilation())
    row = int(np.flatnonzero(np.asarray(whole.extents)[:, 0])[3])
    broken = replace(gaussians, sh=gaussians.sh.at[row, 2].set(jnp.nan))
    found = kernels.project(broken, camera(), Dilation())
    others = np.arange(ROWS) != row
    assert_array_equal(found.extents[row], 0)
    assert_array_equal(found.colors[row], 0)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(whole), strict=True):
        assert_array_equal(a[others], b[others])
