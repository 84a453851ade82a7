"""The projection of every backend must do what `splatax.projection` defines."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.backends import cpu
from splatax.projection import Antialiasing, Dilation
from splatax.rendering import project

REFERENCE = backends.kernels("reference").project
OWN = [name for name in backends.BACKENDS if backends.kernels(name).project is not REFERENCE]
DIFFERENTIABLE = ("means2d", "sqrt_conics", "depths", "colors", "opacities")
FIELDS = (*DIFFERENTIABLE, "extents")
CAMERA = camera_at((0.3, 0.2, -3.0), size=(64, 48))


@pytest.fixture(params=OWN)
def backend(request):
    if reason := backends.why_unavailable(request.param):
        pytest.skip(reason)
    return request.param


def gradients(gaussians, camera, low_pass, backend, weights):
    """Of the weighted sum of everything that is projected."""

    def objective(gaussians, camera):
        splats = project(gaussians, camera, low_pass=low_pass, backend=backend)
        return sum(jnp.sum(getattr(splats, field) * weights[field]) for field in weights)

    return jax.grad(objective, argnums=(0, 1))(gaussians, camera)


@pytest.mark.parametrize("low_pass", [Dilation(), Antialiasing()])
@pytest.mark.parametrize("degree", range(5))
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


@pytest.mark.parametrize("low_pass", [Dilation(), Antialiasing()])
def test_absurd_gaussians_are_culled_and_leave_the_camera_its_gradient(backend, low_pass):
    sound = random_gaussians(n=40)
    broken = sound
    for row, (field, value) in enumerate(
        [
            ("means", np.nan),
            ("means", np.inf),
            ("quats", np.nan),
            ("log_scales", np.nan),
            ("log_scales", 1e4),
            ("log_scales", -1e4),
            ("opacity_logits", np.nan),
            ("opacity_logits", -np.inf),
            ("quats", 0.0),
        ]
    ):
        broken = replace(broken, **{field: getattr(broken, field).at[row].set(value)})
    splats = project(broken, CAMERA, low_pass=low_pass, backend=backend)
    culled = np.asarray(splats.extents[:, 0] == 0)
    assert culled[[0, 1, 2, 3, 4, 6, 7]].all()
    weights = {field: jnp.ones_like(getattr(splats, field)) for field in DIFFERENTIABLE}
    of_gaussians, of_camera = gradients(broken, CAMERA, low_pass, backend, weights)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(of_camera))
    assert all(np.isfinite(leaf[culled]).all() for leaf in jax.tree.leaves(of_gaussians))
    assert all((leaf[culled] == 0).all() for leaf in jax.tree.leaves(of_gaussians))


@pytest.mark.skipif(cpu.BEST.why_unavailable() is not None, reason="no native library")
def test_any_number_of_threads_gives_the_same_bits():
    gaussians = random_gaussians(n=10_000, degree=1)

    def gradient(threads):
        kernels = cpu.kernels(threads=threads)

        def objective(gaussians, camera):
            splats = project(gaussians, camera, backend=kernels)
            return jnp.sum(splats.means2d) + jnp.sum(splats.sqrt_conics * splats.opacities[:, None])

        return jax.grad(objective, argnums=(0, 1))(gaussians, CAMERA)

    for a, b in zip(jax.tree.leaves(gradient(0)), jax.tree.leaves(gradient(1)), strict=True):
        assert_array_equal(a, b)
