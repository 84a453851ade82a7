"""A background that depends on the direction of view."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, random_gaussians

UP = jnp.zeros((4, 3)).at[1].set(0.5)  # brighter along one axis


def test_behind_nothing_each_pixel_shows_the_sky_of_its_own_direction():
    camera = camera_at(size=(8, 6), focal=5.0)
    empty = replace(random_gaussians(n=3), opacity_logits=jnp.full(3, -jnp.inf))
    drawn = sx.render(empty, camera, background=sx.Sky(UP)).rgb
    x, y, z = np.moveaxis(np.asarray(drawn) - 0.5, 2, 0)
    assert_allclose(x, z)
    direction = camera.rotation.T @ camera.to_point(jnp.array([0.5, 0.5]), jnp.float32(1))
    direction /= jnp.linalg.norm(direction)
    assert_allclose(drawn[0, 0, 0] - 0.5, -0.4886025 * 0.5 * direction[1], atol=1e-6)
    assert np.ptp(y) > 0.05


def test_a_sky_is_learned_from_photos():
    truth, camera, scene = sx.Sky(UP), camera_at(size=(12, 9), focal=5.0), random_gaussians(n=20)
    photo = sx.render(scene, camera, background=truth).rgb

    @jax.jit
    @jax.value_and_grad
    def error(sky):
        return jnp.sum((sx.render(scene, camera, background=sky).rgb - photo) ** 2)

    sky = sx.Sky(jnp.zeros((4, 3)))
    before = error(sky)[0]
    for _ in range(200):
        sky = jax.tree.map(lambda value, slope: value - 0.02 * slope, sky, error(sky)[1])
    assert error(sky)[0] < 0.01 * before
