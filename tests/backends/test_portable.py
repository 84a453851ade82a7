"""Tests of the portable rasterizer only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import random_splats
from splatax.backends.portable import binning
from splatax.rendering import composite


def image_and_gradient(scene):
    def objective(scene, channels):
        image, alpha = composite(scene, channels, backend="xla")
        weights = jnp.asarray(np.random.default_rng(0).normal(size=image.shape), jnp.float32)
        return jnp.sum(image * weights) + jnp.sum(alpha * weights[..., 0]), image

    (_, image), gradient = jax.value_and_grad(objective, (0, 1), has_aux=True)(scene, scene.colors)
    return image, gradient


@pytest.mark.slow
def test_more_slots_than_a_round_holds(monkeypatch):
    """The backend that works in rounds must not notice where they end."""
    scene = random_splats(7, n=600, size=(64, 48), sigma=(1, 12))
    image, gradient = image_and_gradient(scene)
    monkeypatch.setattr(binning, "capacity_of_round", lambda splats, grid: 1 << 9)
    monkeypatch.setattr(binning, "MAX_SLOTS", 48 * 200)  # 3 slabs of 200 splats
    jax.clear_caches()
    image_in_rounds, gradient_in_rounds = image_and_gradient(scene)
    jax.clear_caches()
    assert_allclose(image_in_rounds, image, atol=2e-6)
    for a, b in zip(jax.tree.leaves(gradient_in_rounds), jax.tree.leaves(gradient), strict=True):
        assert_allclose(a, b, atol=2e-5 * max(np.abs(b).max(), 1))
