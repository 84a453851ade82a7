"""Levels of detail: fewer Gaussians that look like the scene from afar."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import editing
from splatax.metrics import psnr, to_8bit

CLOUD = random_gaussians(n=1500, degree=0, spread=1.0, scale=(0.03, 0.06))
MEANS = CLOUD.means * jnp.array([[1.0, 1.0, 0.05]])
SCENE = replace(
    CLOUD, means=MEANS, sh=jnp.sin(2 * MEANS)[:, None]
)  # a surface with colours that change slowly


def picture(gaussians):
    return to_8bit(np.asarray(sx.render(gaussians, camera_at((0, 0, -6), size=(48, 40), focal=40.0)).rgb))


def test_levels_have_a_quarter_of_the_one_before_and_the_first_is_the_scene():
    levels = editing.levels_of(SCENE, 3)
    assert [len(level) for level in levels] == [1500, 375, 94]
    assert levels[0] is SCENE
    assert len(editing.levels_of(SCENE)) == 1, "a small scene needs no other"


def test_merged_gaussians_look_more_like_the_scene_than_the_most_important_ones():
    whole = picture(SCENE)
    merged = psnr(picture(editing.coarser(SCENE, 375)), whole)
    kept = psnr(picture(editing.simplify(SCENE, 375)), whole)
    assert merged > kept + 2
    assert merged > 20


def test_two_equal_gaussians_become_one_in_the_middle_that_covers_both():
    one = random_gaussians(n=1, degree=0, scale=(0.1, 0.1001))
    apart = jnp.array([[0.1, 0.0, 0.0]])
    pair = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b]), *(replace(one, means=m) for m in (apart, -apart))
    )
    merged = editing.coarser(pair, 1)
    assert_allclose(merged.means, 0, atol=1e-6)
    assert_allclose(merged.covariances[0], np.diag([0.02, 0.01, 0.01]), atol=5e-5)
    assert_allclose(merged.sh, one.sh, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_gaussians_at_one_place_can_be_merged(count):
    same = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 40), random_gaussians(n=1, degree=0))
    merged = editing.coarser(same, count)
    assert len(merged) == count
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(merged))
    assert editing.coarser(same, 100) is same
