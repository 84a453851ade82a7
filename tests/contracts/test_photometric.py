"""Backends that have a loss of their own must compute what `splatax.losses` does."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from splatax import rasterizers
from splatax.losses import Photometric

OWN = [name for name in rasterizers.BACKENDS if hasattr(rasterizers.implementation(name), "photometric")]


@pytest.fixture(params=OWN)
def backend(request):
    if reason := rasterizers.why_unavailable(request.param):
        pytest.skip(reason)
    return request.param


def pictures(shape):
    """Two that differ, but for a corner where they are equal."""
    image, photo = np.random.default_rng(0).uniform(size=(2, *shape)).astype(np.float32)
    photo[: shape[0] // 3, : shape[1] // 3] = image[: shape[0] // 3, : shape[1] // 3]
    return jnp.asarray(image), jnp.asarray(photo)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("shape", [(37, 53, 3), (3, 7, 3), (64, 5, 3), (5, 64, 3)])
def test_loss_and_gradient_equal_those_of_plain_jax(backend, shape, weight):
    image, photo = pictures(shape)
    loss = Photometric(ssim_weight=weight)
    expected, gradient = jax.value_and_grad(lambda x: loss(x, photo, backend="xla"))(image)
    actual, own = jax.jit(jax.value_and_grad(lambda x: 3 * loss(x, photo, backend=backend)))(image)
    assert_allclose(actual, 3 * expected, atol=1e-6)
    assert_allclose(own, 3 * gradient, atol=3e-6 * np.abs(gradient).max())


def mask_of(shape):
    """Ragged: half of the pixels, chosen at random, but for a corner of those that count."""
    mask = np.random.default_rng(1).uniform(size=shape) < 0.5
    mask[: shape[0] // 2, : shape[1] // 2] = True
    return jnp.asarray(mask)


def test_masked_loss_and_gradient_equal_those_of_plain_jax(backend):
    image, photo = pictures((37, 53, 3))
    mask, loss = mask_of((37, 53)), Photometric()
    expected, gradient = jax.value_and_grad(lambda x: loss(x, photo, mask, backend="xla"))(image)
    actual, own = jax.jit(jax.value_and_grad(lambda x: loss(x, photo, mask, backend=backend)))(image)
    assert_allclose(actual, expected, atol=2e-6)
    assert_allclose(own, gradient, atol=3e-6 * np.abs(gradient).max())


def test_any_number_of_threads_gives_the_same_bits(backend):
    image, photo = pictures((70, 53, 3))
    implementation = rasterizers.implementation(backend)

    def value_and_gradient(threads):
        limited = replace(implementation, threads=threads)
        return jax.value_and_grad(lambda x: limited.photometric(x, photo, 0.2))(image)

    for a, b in zip(value_and_gradient(0), value_and_gradient(1), strict=True):
        assert_array_equal(a, b)
