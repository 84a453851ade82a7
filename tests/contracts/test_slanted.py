"""Splats that are drawn along rays: every backend draws and differentiates them as the reference does."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, plane_of_gaussians, random_gaussians
from splatax.cameras.geometry import rays
from splatax.stages import composite, project, select

FIELDS = ("means2d", "sqrt_conics", "opacities", "slants", "pull")


def view(flat, n=150, dtype=np.float32):
    """Gaussians or discs of all shapes and sizes, near the camera too, over several tiles."""
    gaussians = random_gaussians(n=n, degree=0, spread=1.5, scale=(0.005, 0.5), dtype=dtype)
    if flat:
        gaussians = replace(gaussians, log_scales=gaussians.log_scales.at[:, 2].set(-jnp.inf))
    camera = camera_at((0.3, -0.2, -2.0), size=(41, 35), focal=40.0, dtype=dtype)
    return project(gaussians, camera, low_pass=sx.AlongRays(), backend="reference")


@partial(jax.jit, static_argnames="backend")
def derivatives(splats, cotangent, backend, channels=None):
    """The image and its gradients. The channels are the colours, with `pull`, unless others are given."""

    def loss(splats, channels):
        image, alpha = composite(splats, channels, backend=backend)
        return jnp.sum(cotangent[..., :-1] * image) + jnp.sum(cotangent[..., -1] * alpha), (image, alpha)

    watched = replace(splats, pull=jnp.zeros_like(splats.means2d)) if channels is None else splats
    channels = splats.colors if channels is None else channels
    (_, image), (d_splats, d_channels) = jax.value_and_grad(loss, (0, 1), has_aux=True)(watched, channels)
    gradients = {name: getattr(d_splats, name) for name in FIELDS} | {"channels": d_channels}
    return image, {name: value for name, value in gradients.items() if value is not None}


def assert_gradients_close(found, expected):
    for name, value in expected.items():
        each = np.abs(np.asarray(value)).reshape(len(value), -1).max(axis=1)  # sums of squares of pixels
        error = np.abs(np.asarray(found[name] - value)).reshape(len(value), -1).max(axis=1)
        assert (error <= 2e-3 * each + 2e-4 * np.median(each) + 1e-6).all(), name


@pytest.mark.parametrize("flat", [False, True])
def test_images_and_gradients_are_those_of_the_reference(fast, flat):
    splats = view(flat)
    cotangent = jnp.asarray(np.random.default_rng(0).normal(size=(35, 41, 4)), jnp.float32)
    (image, alpha), gradients = derivatives(splats, cotangent, fast)
    (image_true, alpha_true), gradients_true = derivatives(splats, cotangent, "reference")
    assert_allclose(image, image_true, atol=2e-5)
    assert_allclose(alpha, alpha_true, atol=2e-5)
    assert_gradients_close(gradients, gradients_true)


@pytest.mark.parametrize("count", [9, 17])
def test_many_channels_have_the_images_and_gradients_of_the_reference(fast, count):
    splats, rng = view(True, n=100), np.random.default_rng(0)
    channels = jnp.asarray(rng.normal(size=(100, count)), jnp.float32)
    cotangent = jnp.asarray(rng.normal(size=(35, 41, count + 1)), jnp.float32)
    (image, alpha), gradients = derivatives(splats, cotangent, fast, channels)
    (image_true, alpha_true), gradients_true = derivatives(splats, cotangent, "reference", channels)
    assert_allclose(image, image_true, atol=5e-5)
    assert_allclose(alpha, alpha_true, atol=2e-5)
    assert_gradients_close(gradients, gradients_true)


def test_selection_is_that_of_the_reference(fast):
    splats = view(True)
    found, expected = select(splats, 4, backend=fast), select(splats, 4, backend="reference")
    assert_allclose(found.weights, expected.weights, atol=2e-5)
    assert (np.asarray(found.median) == np.asarray(expected.median)).mean() > 0.995  # ties of rounding


def test_the_same_bits_twice_and_in_a_batch(fast):
    splats = view(True, n=60)
    first, second = (composite(splats, splats.colors, backend=fast)[0] for _ in range(2))
    assert_array_equal(first, second)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), splats)
    both = jax.vmap(lambda splats: composite(splats, splats.colors, backend=fast)[0])(batch)
    assert_allclose(both, jnp.stack([first, first]), atol=1e-6)


def test_forward_mode_agrees_with_reverse_mode(fast):
    splats = view(True, n=40)
    rng = np.random.default_rng(1)
    cotangent = jnp.asarray(rng.normal(size=(35, 41, 3)), jnp.float32)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 1e-3, leaf.dtype), splats)
    still = {name: jnp.zeros_like(getattr(splats, name)) for name in ("depths", "extents", "colors")}
    direction = replace(direction, **still, slants=direction.slants.at[:, 5].set(0))

    def loss(splats):
        return jnp.sum(cotangent * composite(splats, jax.lax.stop_gradient(splats.colors), backend=fast)[0])

    _, forward = jax.jvp(loss, (splats,), (direction,))
    pairs = zip(jax.tree.leaves(jax.grad(loss)(splats)), jax.tree.leaves(direction), strict=True)
    assert_allclose(forward, sum(jnp.vdot(a, b) for a, b in pairs), rtol=2e-3)


def test_a_plane_of_discs_has_its_exact_depth_and_normal(backend):
    normal = np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])
    camera = camera_at((0.4, -0.3, -4.0), size=(32, 24), focal=40.0)
    discs = plane_of_gaussians(normal, n=900, flat=1e-12)
    outputs = ("surface_depth", "median_surface_depth", "normals", "alpha")
    drawn = sx.render(discs, camera, low_pass=sx.AlongRays(), outputs=outputs, backend=backend)
    origin, directions = np.asarray(camera.position, np.float64), np.asarray(rays(camera), np.float64)
    points = origin - directions * ((normal @ origin) / (directions @ normal))[..., None]
    expected = points @ np.asarray(camera.rotation[2], np.float64) + float(camera.translation[2])
    covered = np.asarray(drawn.alpha) > 0.5
    assert covered.sum() > 200
    assert_allclose(drawn.surface_depth[covered], expected[covered], rtol=1e-5)
    assert_allclose(drawn.median_surface_depth[covered], expected[covered], rtol=1e-5)
    assert_allclose(drawn.normals[covered], np.broadcast_to(normal, (covered.sum(), 3)), atol=1e-6)
