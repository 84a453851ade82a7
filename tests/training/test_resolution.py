"""Photos that are smaller in the first part of a run."""

from dataclasses import replace
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenes import camera_at
from splatax import backends
from splatax.dataset import View
from splatax.low_pass import Dilation
from splatax.training.feed import Batch, batches
from splatax.training.initialize import FromPoints
from splatax.training.loop import first_state
from splatax.training.resolution import Resolution, divided
from splatax.training.step import compare
from training.test_training import RECIPE, capture


def test_stages_end_with_their_last_step():
    resolution = Resolution(((2, 4), (3, 2)))
    assert [resolution.divisor(step, (6, 4)) for step in range(1, 6)] == [4, 4, 2, 1, 1]


def test_pixels_of_a_divided_photo_are_means():
    photo = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    camera, smaller, mask = divided(camera_at(size=(6, 4)), photo, None, 2)
    assert (camera.width, camera.height) == (3, 2)
    assert np.allclose(smaller, photo.reshape(2, 2, 3, 2, 3).mean(axis=(1, 3)), atol=0.5)
    assert mask is None


def test_photos_that_would_become_too_small_keep_their_size():
    assert Resolution(((9, 2),), smallest=21).divisor(1, (63, 40)) == 1
    assert Resolution(((9, 2),), smallest=20).divisor(1, (63, 40)) == 2
    assert Resolution(((9, 2),)).divisor(1, (63, 1)) == 1


def test_the_low_pass_filter_is_of_pixels_of_the_whole_photo():
    dataset = capture()
    gaussians = FromPoints()(dataset, 1, 0)
    state = first_state(gaussians, RECIPE, 1.0, len(dataset.train))
    view = dataset.train[0]
    photo = jnp.asarray(view.pixels())
    wider = replace(RECIPE.drawing, low_pass=replace(Dilation(), variance=4 * Dilation().variance))
    losses = [
        compare(
            state,
            Batch(view.camera, photo, divisor=divisor),
            recipe.on(backends.resolve("auto")),
            jax.random.key(0),
        )[0]
        for divisor, recipe in ((1, RECIPE), (2, replace(RECIPE, drawing=wider)), (2, RECIPE))
    ]
    assert losses[0] == losses[1] != losses[2]


def test_a_divided_camera_sees_a_point_at_the_same_place_of_the_photo():
    camera = camera_at(size=(63, 40))
    smaller, _, _ = divided(camera, np.zeros((40, 63, 3), np.uint8), None, 4)
    point = jnp.array([0.3, -0.2, 2.0])
    at = camera.to_pixel(point) / np.array([63, 40])
    assert np.allclose(smaller.to_pixel(point) / np.array([smaller.width, smaller.height]), at, atol=1e-6)


def test_a_pixel_counts_only_where_all_that_it_covers_does():
    mask = np.ones((4, 4), bool)
    mask[0, 0] = False
    _, _, smaller = divided(camera_at(size=(4, 4)), np.zeros((4, 4, 3), np.uint8), mask, 2)
    assert smaller.tolist() == [[False, True], [True, True]]


@pytest.mark.parametrize("start", [0, 1, 2, 3])
def test_a_resumed_run_sees_photos_of_the_same_sizes(start):
    camera = camera_at(size=(8, 6))
    pixels = np.random.default_rng(0).integers(0, 255, (3, 6, 8, 3)).astype(np.uint8)
    views = [View(str(i), camera, lambda i=i: pixels[i]) for i in range(3)]
    resolution = Resolution(((2, 2),))
    whole = list(islice(batches(views, 0, 0, resolution), 6))
    assert [batch.camera.width for batch in whole] == [4, 4, 8, 8, 8, 8]
    rest = islice(batches(views, 0, start, resolution), 6 - start)
    for expected, batch in zip(whole[start:], rest, strict=True):
        assert np.array_equal(expected.photo, batch.photo)
