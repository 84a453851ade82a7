"""The projection of every backend equals the one that `splatax.projection` defines."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from enrolled import NAMES, available, kernels
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.backends import cpu
from splatax.low_pass import Antialiasing, Dilation
from splatax.rendering import project, render

REFERENCE = backends.kernels("reference").project
DIFFERENTIABLE = ("means2d", "sqrt_conics", "depths", "colors", "opacities")
FIELDS = (*DIFFERENTIABLE, "extents")
CAMERA = camera_at((0.3, 0.2, -3.0), size=(64, 48))


@pytest.fixture(params=NAMES)
def backend(request):
    if kernels(request.param).project is REFERENCE:
        pytest.skip("it takes the projection of plain JAX")
    return available(request.param)


@pytest.fixture(params=[name for name in NAMES if name != "reference"])
def any_backend(request):
    return available(request.param)


def gradients(gaussians, camera, low_pass, backend, weights):
    """Of the weighted sum of everything that is projected."""

    def objective(gaussians, camera):
        splats = project(gaussians, camera, low_pass=low_pass, backend=backend)
        return sum(jnp.sum(getattr(splats, field) * weights[field]) for field in weights)

    return jax.grad(objective, argnums=(0, 1))(gaussians, camera)


@pytest.mark.parametrize(
    ("degree", "low_pass"),
    # The filter knows nothing of harmonics: one degree is enough for the other one.
    [*((degree, Dilation()) for degree in range(5)), (2, Antialiasing())],
    ids=lambda value: f"degree{value}" if isinstance(value, int) else type(value).__name__,
)
def test_splats_and_all_gradients_equal_those_of_plain_jax(backend, degree, low_pass):
    # Spread so far that some are behind the camera, beside the image, or beside the frustum's margin.
    gaussians = random_gaussians(seed=degree, n=500, degree=degree, spread=2.5)
    expected = project(gaussians, CAMERA, low_pass=low_pass, backend="xla")
    actual = project(gaussians, CAMERA, low_pass=low_pass, backend=backend)
    visible = np.asarray(expected.extents[:, 0] > 0)
    assert 50 < visible.sum() < 450
    assert_array_equal(actual.extents[:, 0] > 0, visible)
    for field in FIELDS:
        value = np.asarray(getattr(expected, field))[visible]
        error = 2e-6 * np.abs(value).max()  # several float32 roundings
        assert_allclose(np.asarray(getattr(actual, field))[visible], value, atol=error, err_msg=field)

    rng = np.random.default_rng(0)
    weights = {}
    for field in DIFFERENTIABLE:
        shape = getattr(expected, field).shape
        mask = visible.reshape(-1, *[1] * (len(shape) - 1))  # a rasterizer sends nothing to the culled
        weights[field] = jnp.asarray(rng.normal(size=shape) * mask, jnp.float32)
    of_jax, own = (gradients(gaussians, CAMERA, low_pass, name, weights) for name in ("xla", backend))
    for a, b in zip(jax.tree.leaves(own), jax.tree.leaves(of_jax), strict=True):
        # A camera's are sums of hundreds of numbers of either sign.
        assert_allclose(a, b, atol=1e-4 * np.abs(b).max())


BROKEN = {  # what no Gaussian can be drawn with, by field
    "means": (np.nan, np.inf, -np.inf),
    "quats": (np.nan, np.inf, -np.inf),
    "log_scales": (np.nan, np.inf, 1e4),
    "opacity_logits": (np.nan,),
    "sh": (np.nan, np.inf, -np.inf),
}


def broken_copies(gaussians):
    """Copies of the first Gaussian, each with one of its numbers broken in one way."""
    first = jax.tree.map(lambda leaf: np.asarray(leaf[:1]), gaussians)
    copies = []
    for field, values in BROKEN.items():
        for place in np.ndindex(getattr(first, field).shape[1:]):
            for value in values:
                array = getattr(first, field).copy()
                array[(0, *place)] = value
                copies.append(replace(first, **{field: array}))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *copies)


@pytest.mark.parametrize("low_pass", [Dilation(), Antialiasing(), Dilation(0.0)])
def test_a_number_that_is_not_finite_culls_its_gaussian_and_changes_no_gradient(any_backend, low_pass):
    sound = random_gaussians(n=60, degree=1, spread=3.0)
    broken = broken_copies(random_gaussians(n=1, degree=1, spread=0.1))
    count = len(broken)
    assert count == 3 * 3 + 4 * 3 + 3 * 3 + 1 + 12 * 3
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), broken, sound)
    splats = project(both, CAMERA, low_pass=low_pass, backend=any_backend)
    alone = project(sound, CAMERA, low_pass=low_pass, backend=any_backend)
    assert_array_equal(splats.extents[:count], 0)
    for field in FIELDS:
        assert np.isfinite(getattr(splats, field)).all(), field
        assert_allclose(getattr(splats, field)[count:], getattr(alone, field), rtol=1e-6, err_msg=field)

    seen = alone.extents[:, :1] > 0
    assert 10 < np.count_nonzero(seen) < 60
    weights = {
        field: jnp.where(seen if getattr(alone, field).ndim == 2 else seen[:, 0], 1.0, 0.0)
        * jnp.ones_like(getattr(alone, field))
        for field in DIFFERENTIABLE
    }
    with_zeros = {
        field: jnp.concatenate([jnp.zeros((count, *weight.shape[1:])), weight])
        for field, weight in weights.items()
    }
    expected, expected_camera = gradients(sound, CAMERA, low_pass, any_backend, weights)
    found, camera = gradients(both, CAMERA, low_pass, any_backend, with_zeros)
    for a, b in zip(jax.tree.leaves(camera), jax.tree.leaves(expected_camera), strict=True):
        assert_allclose(a, b, atol=1e-5 * max(np.abs(b).max(), 1))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_array_equal(a[:count], 0)
        assert_allclose(a[count:], b, atol=1e-5 * max(np.abs(b).max(), 1))


def test_a_picture_of_a_scene_with_broken_gaussians_has_finite_gradients(any_backend):
    """With the filter that makes the most of a footprint; the test above has the others."""
    sound = random_gaussians(n=40, degree=1)
    broken = broken_copies(random_gaussians(n=1, degree=1, spread=0.1))
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), broken, sound)

    def loss(gaussians, camera):
        image = render(gaussians, camera, low_pass=Antialiasing(), backend=any_backend)
        return jnp.sum(image.rgb**2) + jnp.sum(image.depth)

    for a, b in zip(
        jax.tree.leaves(jax.grad(loss, (0, 1))(both, CAMERA)),
        jax.tree.leaves(jax.grad(loss, (0, 1))(sound, CAMERA)),
        strict=True,
    ):
        assert np.isfinite(a).all()
        a = a[len(broken) :] if len(a.shape) and len(a) == len(both) else a
        assert_allclose(a, b, atol=1e-4 * max(np.abs(b).max(), 1))


def test_infinite_numbers_that_mean_something_are_drawn(any_backend):
    gaussians = random_gaussians(n=3, degree=0, spread=0.1)
    opaque, empty, flat = np.inf, -np.inf, -np.inf
    logits = jnp.array([opaque, empty, 1.0])
    log_scales = gaussians.log_scales.at[2, 1].set(flat)
    gaussians = replace(gaussians, opacity_logits=logits, log_scales=log_scales)
    splats = project(gaussians, CAMERA, backend=any_backend)
    assert_array_equal(splats.extents[:, 0] > 0, [True, False, True])
    assert_allclose(splats.opacities[:2], [1, 0], atol=1e-6)
    gradient = jax.grad(lambda g: render(g, CAMERA, backend=any_backend).rgb.sum())(gaussians)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.skipif(cpu.BEST.why_unavailable() is not None, reason="no native library")
def test_any_number_of_threads_gives_the_same_bits():
    gaussians = random_gaussians(n=10_000, degree=1)

    def gradient(threads):
        build = cpu.kernels(threads=threads)

        def objective(gaussians, camera):
            splats = project(gaussians, camera, backend=build)
            return jnp.sum(splats.means2d) + jnp.sum(splats.sqrt_conics * splats.opacities[:, None])

        return jax.grad(objective, argnums=(0, 1))(gaussians, CAMERA)

    for a, b in zip(jax.tree.leaves(gradient(0)), jax.tree.leaves(gradient(1)), strict=True):
        assert_array_equal(a, b)
