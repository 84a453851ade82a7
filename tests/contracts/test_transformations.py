"""`render` and its gradient compose with every transformation of JAX, on every backend."""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import camera_at, random_gaussians
from splatax.rendering import render

GAUSSIANS = random_gaussians(n=30, degree=1)
CAMERAS = [camera_at((x, 0.3, -4), size=(16, 12), focal=14.0) for x in (-0.5, 0.0, 0.5)]
STACKED = jax.tree.map(lambda *leaves: jnp.stack(leaves), *CAMERAS)
WEIGHTS = jnp.asarray(np.random.default_rng(0).normal(size=(12, 16, 3)), jnp.float32)


@cache
def loss_of(backend):
    return lambda gaussians, camera: jnp.sum(render(gaussians, camera, backend=backend).rgb * WEIGHTS)


@cache
def one_by_one(backend):
    return [jax.value_and_grad(loss_of(backend), (0, 1))(GAUSSIANS, camera) for camera in CAMERAS]


@pytest.fixture
def loss(backend):
    return loss_of(backend)


@pytest.fixture
def expected(backend):
    """Losses of the cameras, and gradients in scene and camera, one after the other."""
    return one_by_one(backend)


def assert_same(actual, expected):
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert_allclose(a, b, atol=1e-5 * max(np.abs(b).max(), 1))


def test_jit(loss, expected):
    compiled = jax.jit(jax.value_and_grad(loss, (0, 1)))
    assert_same([compiled(GAUSSIANS, camera) for camera in CAMERAS], expected)


def test_vmap_over_cameras(loss, expected):
    found = jax.vmap(jax.value_and_grad(loss, (0, 1)), (None, 0))(GAUSSIANS, STACKED)
    assert_same(found, jax.tree.map(lambda *leaves: jnp.stack(leaves), *expected))


def test_gradient_of_vmap(loss, expected):
    total = jax.grad(lambda g: jnp.sum(jax.vmap(loss, (None, 0))(g, STACKED)))(GAUSSIANS)
    assert_same(total, jax.tree.map(lambda *leaves: sum(leaves), *(scene for _, (scene, _) in expected)))


def test_scan_over_cameras(loss, expected):
    def total(gaussians):
        return jax.lax.scan(lambda sum, camera: (sum + loss(gaussians, camera), None), 0.0, STACKED)[0]

    value, gradient = jax.value_and_grad(total)(GAUSSIANS)
    assert_allclose(value, sum(value for value, _ in expected), rtol=1e-5)
    assert_same(gradient, jax.tree.map(lambda *leaves: sum(leaves), *(scene for _, (scene, _) in expected)))


def test_checkpoint(loss, expected):
    found = jax.value_and_grad(jax.checkpoint(loss), (0, 1))(GAUSSIANS, CAMERAS[0])
    assert_same(found, expected[0])


@pytest.mark.slow
def test_shard_map_on_eight_devices(backend):
    folder = Path(__file__).parent
    folders = [str(folder.parent), str(folder.parents[1] / "src"), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, str(folder / "sharded.py"), getattr(backend, "name", backend)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
