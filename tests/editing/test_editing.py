"""Edits keep the Gaussians that they should keep, and no others."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import editing
from splatax.cameras.rig import up_of
from splatax.errors import InputError

CAMERA = camera_at(size=(64, 48), focal=60.0)


def scene(n=400):
    gaussians = random_gaussians(n=n, degree=1)
    return replace(gaussians, opacity_logits=jnp.abs(gaussians.opacity_logits))


def test_cleaning_counts_what_it_removes_by_the_first_reason():
    gaussians = scene()
    means = gaussians.means.at[0, 1].set(jnp.nan).at[1].set(50.0).at[2, 0].set(-jnp.inf)
    logits = gaussians.opacity_logits.at[3].set(-8.0).at[0].set(-8.0)
    flat = gaussians.log_scales.at[5, 2].set(-jnp.inf)
    left, removed = editing.clean(replace(gaussians, means=means, opacity_logits=logits, log_scales=flat))
    assert removed == {"not finite": 2, "too faint": 1, "never seen": 0, "floating": 1}
    assert_array_equal(left.means, means[np.setdiff1d(np.arange(400), [0, 1, 2, 3])])
    assert np.isneginf(left.log_scales).sum() == 1


def test_cleaning_a_sound_scene_changes_nothing():
    left, removed = editing.clean(scene())
    assert_array_equal(left.means, scene().means)
    assert set(removed.values()) == {0}


def test_cleaning_keeps_the_large_gaussians_of_a_sparse_background():
    gaussians = scene()
    means = gaussians.means.at[:3].multiply(100.0)
    large = gaussians.log_scales.at[:2].set(jnp.log(60.0))
    left, removed = editing.clean(replace(gaussians, means=means, log_scales=large))
    assert removed["floating"] == 1
    assert_array_equal(left.means[:2], means[:2])


def test_what_no_camera_saw_is_cleaned_and_the_picture_stays():
    gaussians = scene()
    gaussians = replace(gaussians, means=gaussians.means.at[:100, 2].add(-10.0))  # behind the camera
    weights = editing.visible_weights(gaussians, [CAMERA])
    left, removed = editing.clean(gaussians, weights=weights, deviations=1e3)
    assert removed["never seen"] >= 100
    assert_allclose(sx.render(left, CAMERA).rgb, sx.render(gaussians, CAMERA).rgb, atol=0.05)


def test_visible_weights_are_pixels():
    """They add up to the alpha of the whole picture, and count what is hidden little."""
    gaussians = scene()
    weights = editing.visible_weights(gaussians, [CAMERA])
    assert_allclose(weights.sum(), sx.render(gaussians, CAMERA).alpha.sum(), rtol=1e-4)
    twice = editing.visible_weights(gaussians, [CAMERA, CAMERA])
    assert_allclose(twice, 2 * weights, rtol=1e-5, atol=1e-6)


def test_crops_keep_what_is_inside():
    means = np.asarray(scene().means)
    box = editing.crop(scene(), editing.Box((-0.5, -1.0, 0.0), (0.5, 1.0, 1.0)))
    inside = (np.abs(means[:, 0]) <= 0.5) & (means[:, 2] >= 0)
    assert 0 < inside.sum() < 400
    assert_array_equal(box.means, means[inside])
    ball = editing.crop(scene(), editing.Sphere((0.2, 0.0, 0.0), 0.6))
    assert_array_equal(ball.means, means[np.linalg.norm(means - [0.2, 0, 0], axis=1) <= 0.6])


def test_simplifying_keeps_the_number_asked_for_and_those_that_matter():
    gaussians = scene()
    weights = editing.visible_weights(gaussians, [CAMERA])
    left = editing.simplify(gaussians, 200, weights=weights)
    assert len(left) == 200
    assert len(editing.simplify(gaussians, 1000)) == 400
    kept = np.isin(np.asarray(gaussians.means)[:, 0], np.asarray(left.means)[:, 0])
    assert weights[kept].min() >= weights[~kept].max()

    def error(g):
        return float(jnp.abs(sx.render(g, CAMERA).rgb - sx.render(gaussians, CAMERA).rgb).mean())

    random = jax.tree.map(lambda leaf: leaf[::2], gaussians)
    assert error(left) < 0.5 * error(random)


def test_without_cameras_large_and_opaque_ones_matter():
    gaussians = scene(n=4)
    gaussians = replace(
        gaussians,
        log_scales=jnp.log(jnp.array([[1, 1, 1e-9], [0.5, 0.5, 0.5], [2, 0.01, 0.01], [1, 1, 1]])),
        opacity_logits=jnp.array([5.0, 5.0, 5.0, -5.0]),
    )
    left = editing.simplify(gaussians, 2)
    assert_array_equal(left.means, gaussians.means[:2])


def test_scenes_of_different_filters_are_not_merged():
    plain = random_gaussians(n=5)
    with pytest.raises(sx.InputError, match="trained with different low-pass filters"):
        editing.merge([plain, replace(plain, low_pass=sx.Antialiasing())])


def test_merged_scenes_are_drawn_by_distance_if_all_of_them_are():
    plain = random_gaussians(n=5)
    far = replace(plain, order="distance")
    assert editing.merge([far, far]).order == "distance"
    assert editing.merge([far, plain]).order == "depth"


def test_merged_scenes_have_all_gaussians_and_the_most_harmonics():
    a, b = random_gaussians(n=5, degree=0), random_gaussians(1, n=7, degree=2)
    merged = editing.merge([a, b])
    assert merged.sh.shape == (12, 9, 3)
    assert_array_equal(merged.means, np.concatenate([a.means, b.means]))
    assert_array_equal(merged.sh[:5, 1:], 0)
    assert_array_equal(merged.sh[5:], b.sh)


def test_harmonics_are_reduced_and_never_raised():
    gaussians = random_gaussians(n=5, degree=3)
    assert_array_equal(editing.reduce_degree(gaussians, 1).sh, gaussians.sh[:, :4])
    assert_array_equal(editing.reduce_degree(gaussians, 4).sh, gaussians.sh)


def test_levelling_turns_the_cameras_up_to_minus_y():
    tilted = sx.look_at(jnp.array([0.0, 0.0, -4.0]), jnp.zeros(3), jnp.array([1.0, 1.0, 0.0]))
    cameras = [replace(CAMERA, cam_from_world=tilted)]
    place = editing.level(cameras)
    assert_allclose(place.rotation @ up_of(cameras), [0, -1, 0], atol=1e-6)
    upright = place.transform_camera(cameras[0])
    assert_allclose(upright.rotation[1], [0, 1, 0], atol=1e-6)


def test_levelling_an_upside_down_scene_and_an_upright_one():
    upside_down = sx.look_at(jnp.array([0.0, 0.0, -4.0]), jnp.zeros(3), jnp.array([0.0, 1.0, 0.0]))
    place = editing.level([replace(CAMERA, cam_from_world=upside_down)])
    assert_allclose(place.rotation @ [0, 1, 0], [0, -1, 0], atol=1e-6)
    assert_allclose(editing.level([CAMERA]).rotation, np.eye(3), atol=1e-6)


def test_cameras_that_disagree_about_up_are_refused():
    ups = ([0.0, 1.0, 0.0], [0.0, -1.0, 0.0])
    poses = [sx.look_at(jnp.array([0.0, 0.0, -4.0]), jnp.zeros(3), jnp.array(up)) for up in ups]
    with pytest.raises(InputError, match="Give a rotation"):
        editing.level([replace(CAMERA, cam_from_world=pose) for pose in poses])
