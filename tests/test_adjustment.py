"""Poses adjusted to photos: small errors are corrected, right poses stay, the scene is unchanged."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import metrics
from splatax.adjustment import adjusted, evaluate_adjusted, picture_motion
from splatax.math import rigid

SCENE = random_gaussians(n=60, degree=0, spread=0.8, scale=(0.05, 0.25))
RENDERER = sx.Renderer()
TWIST = jnp.array([0.02, -0.04, 0.02, 0.06, 0.02, -0.05])  # about two pixels


def view_of(name="a.png", mask=None, change=lambda photo: photo):
    camera = camera_at((0.3, -0.2, -4.0), size=(48, 36), focal=45.0)
    photo = change(metrics.to_8bit(np.asarray(RENDERER(SCENE, camera).rgb)))
    return sx.View(name, camera, lambda: photo, mask=mask)


def moved(view, twist=TWIST):
    pose = rigid.exponential(twist) @ view.camera.cam_from_world
    return replace(view, camera=replace(view.camera, cam_from_world=pose))


def test_a_pose_that_is_off_by_pixels_comes_back():
    right = view_of()
    wrong = moved(right)
    assert picture_motion(SCENE, right.camera, wrong.camera) > 1
    (found,) = adjusted(SCENE, [wrong], RENDERER)
    assert picture_motion(SCENE, right.camera, found.view.camera) < 0.02
    assert found.motion == pytest.approx(picture_motion(SCENE, right.camera, wrong.camera), rel=0.02)
    before = sx.evaluate(SCENE, [wrong], renderer=RENDERER)
    after = evaluate_adjusted(SCENE, [wrong], renderer=RENDERER)
    assert after.scores.psnr > before.psnr + 15
    assert after.scores.views[0].name == "a.png"


def test_a_right_pose_stays():
    (found,) = adjusted(SCENE, [view_of()], RENDERER)
    assert found.motion < 0.01


def test_a_photo_moves_its_own_pose_only():
    right, wrong = view_of("a.png"), moved(view_of("b.png"))
    alone = adjusted(SCENE, [right], RENDERER)
    together = adjusted(SCENE, [wrong, right], RENDERER)
    np.testing.assert_array_equal(alone[0].view.camera.cam_from_world, together[1].view.camera.cam_from_world)


def test_masked_pixels_have_no_part_in_it():
    counts = np.ones((36, 48), bool)
    counts[:, 30:] = False

    def scribbled(photo):
        return np.where(counts[..., None], photo, np.uint8(255))

    wrong = moved(view_of(mask=lambda: counts, change=scribbled))
    (found,) = adjusted(SCENE, [wrong], RENDERER)
    assert picture_motion(SCENE, view_of().camera, found.view.camera) < 0.05


def test_a_pose_is_never_left_for_a_worse_one():
    """A photo of something else: whatever the search does, its error falls or stays."""
    noise = np.random.default_rng(0).integers(0, 255, (36, 48, 3), np.uint8)
    view = view_of(change=lambda photo: noise)
    before = sx.evaluate(SCENE, [view], renderer=RENDERER)
    after = evaluate_adjusted(SCENE, [view], renderer=RENDERER)
    assert after.scores.psnr >= before.psnr - 0.01  # rounding to 8 bits
