"""Runs every backend under jax.shard_map on eight host devices; `test_transformations.py` calls it.

It is a program of its own, because the number of devices is fixed when JAX starts.
"""

import sys

import jax

jax.config.update("jax_num_cpu_devices", 8)
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from enrolled import available  # noqa: E402
from jax.sharding import PartitionSpec as P  # noqa: E402
from numpy.testing import assert_allclose  # noqa: E402

from scenes import camera_at, random_gaussians  # noqa: E402
from splatax.backends.protocol import Kernels  # noqa: E402
from splatax.rendering import render  # noqa: E402

DEVICES = 8
GAUSSIANS = random_gaussians(n=20, degree=1)
CAMERAS = [camera_at((0.2 * i - 0.7, 0.3, -4), size=(16, 8), focal=14.0) for i in range(DEVICES)]
WEIGHTS = jnp.asarray(np.random.default_rng(0).normal(size=(DEVICES, 8, 16, 3)), jnp.float32)


def alone(backend: str | Kernels):
    """Returns the image of each camera, and the sums over cameras of their losses' gradients."""

    @jax.jit
    def drawn(gaussians, camera, weight):
        def loss(gaussians, camera):
            image = render(gaussians, camera, backend=backend).rgb
            return jnp.sum(image * weight), image

        gradients, image = jax.grad(loss, argnums=(0, 1), has_aux=True)(gaussians, camera)
        return image, gradients

    images, gradients = zip(
        *(drawn(GAUSSIANS, c, w) for c, w in zip(CAMERAS, WEIGHTS, strict=True)), strict=True
    )
    by_scene = jax.tree.map(lambda *leaves: sum(leaves), *(scene for scene, _ in gradients))
    return (
        images,
        by_scene,
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *(camera for _, camera in gradients)),
    )


def check(backend: str | Kernels, check_vma: bool, expected) -> None:
    """Compares images and gradients of a scene that all devices share with those of a loop over cameras."""
    expected_images, expected_scene, expected_cameras = expected
    mesh = jax.make_mesh((DEVICES,), ("view",), axis_types=(jax.sharding.AxisType.Auto,))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *CAMERAS)

    def sharded(function, out_specs):
        specs = (P(), P("view"), P("view"))
        return jax.jit(
            jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out_specs, check_vma=check_vma)
        )

    def own(tree):
        return jax.tree.map(lambda leaf: leaf[0], tree)

    def view_loss(gaussians, camera, weight):
        return jnp.sum(render(gaussians, camera, backend=backend).rgb * weight)

    images = sharded(lambda g, c, w: render(g, own(c), backend=backend).rgb[None], P("view"))
    for image, wanted in zip(images(GAUSSIANS, stacked, WEIGHTS), expected_images, strict=True):
        assert_allclose(image, wanted, atol=1e-6)

    total = sharded(lambda g, c, w: jax.lax.psum(view_loss(g, own(c), own(w)), "view"), P())
    found = jax.grad(total, argnums=(0, 1))(GAUSSIANS, stacked, WEIGHTS)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves((expected_scene, expected_cameras)), strict=True):
        assert_allclose(a, b, atol=1e-5 * np.abs(b).max())

    # The gradient inside: with check_vma, JAX sums that of a shared scene over the devices by itself.
    def mean_gradient(g, c, w):
        d = jax.grad(view_loss)(g, own(c), own(w))
        return d if check_vma else jax.lax.psum(d, "view")

    inside = sharded(mean_gradient, P())(GAUSSIANS, stacked, WEIGHTS)
    for a, b in zip(jax.tree.leaves(inside), jax.tree.leaves(expected_scene), strict=True):
        assert_allclose(a, b, atol=1e-5 * np.abs(b).max())


if __name__ == "__main__":
    assert jax.device_count() == DEVICES
    chosen = available(sys.argv[1])
    expected = alone(chosen)
    for check_vma in (True, False):
        check(chosen, check_vma, expected)
