"""The loss of every backend equals the one that `splatax.losses` defines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from enrolled import NAMES, kernels
from numpy.testing import assert_allclose, assert_array_equal

from splatax import backends
from splatax.backends import cpu
from splatax.losses import Photometric

REFERENCE = backends.kernels("reference").photometric


@pytest.fixture(params=NAMES)
def kernel(request):
    found = kernels(request.param).photometric
    if found is REFERENCE:
        pytest.skip("it takes the loss of plain JAX")
    return found


def pictures(shape):
    """Two that differ, but for a corner where they are equal."""
    image, photo = np.random.default_rng(0).uniform(size=(2, *shape)).astype(np.float32)
    photo[: shape[0] // 3, : shape[1] // 3] = image[: shape[0] // 3, : shape[1] // 3]
    return jnp.asarray(image), jnp.asarray(photo)


@pytest.mark.parametrize(
    ("shape", "weight"),
    [
        ((37, 53, 3), 0.0),
        ((37, 53, 3), 1.0),
        *((shape, 0.2) for shape in ((3, 7, 3), (64, 5, 3), (5, 64, 3))),
    ],
)
def test_loss_and_gradient_equal_those_of_plain_jax(kernel, shape, weight):
    image, photo = pictures(shape)
    loss = Photometric(ssim_weight=weight)
    expected, gradient = jax.jit(jax.value_and_grad(lambda x: loss(x, photo)))(image)
    actual, own = jax.jit(jax.value_and_grad(lambda x: 3 * loss(x, photo, kernel=kernel)))(image)
    assert_allclose(actual, 3 * expected, atol=1e-6)
    assert_allclose(own, 3 * gradient, atol=3e-6 * np.abs(gradient).max())


def mask_of(shape):
    """Ragged: half of the pixels, chosen at random, but for a corner of those that count."""
    mask = np.random.default_rng(1).uniform(size=shape) < 0.5
    mask[: shape[0] // 2, : shape[1] // 2] = True
    return jnp.asarray(mask)


def test_masked_loss_and_gradient_equal_those_of_plain_jax(kernel):
    image, photo = pictures((37, 53, 3))
    mask, loss = mask_of((37, 53)), Photometric()
    expected, gradient = jax.jit(jax.value_and_grad(lambda x: loss(x, photo, mask)))(image)
    actual, own = jax.jit(jax.value_and_grad(lambda x: loss(x, photo, mask, kernel)))(image)
    assert_allclose(actual, expected, atol=2e-6)
    assert_allclose(own, gradient, atol=3e-6 * np.abs(gradient).max())


@pytest.mark.skipif(cpu.BEST.why_unavailable() is not None, reason="no native library")
def test_any_number_of_threads_gives_the_same_bits():
    image, photo = pictures((70, 53, 3))

    def value_and_gradient(threads):
        kernel = cpu.kernels(threads=threads).photometric
        return jax.value_and_grad(lambda x: kernel(x, photo, 0.2))(image)

    for a, b in zip(value_and_gradient(0), value_and_gradient(1), strict=True):
        assert_array_equal(a, b)
