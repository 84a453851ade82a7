"""Training on photos with masks."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.errors import DatasetError
from splatax.evaluation import picture
from splatax.training.recipes import ShSchedule

SIZE = (40, 32)
RECIPE = sx.Recipe(steps=6, sh=ShSchedule(0))


def left_half():
    mask = np.zeros((32, 40), bool)
    mask[:, :20] = True
    return mask


def capture(spoil=lambda photo: photo, mask=left_half):
    """Three views of a cloud; `spoil` changes each photo."""
    truth = random_gaussians(degree=0)
    cameras = [camera_at((np.sin(i), 0.0, -4.0), size=SIZE) for i in range(3)]
    photos = [spoil(np.asarray(picture(truth, camera))) for camera in cameras]
    views = tuple(
        sx.View(f"{i}.png", camera, lambda photo=photo: photo, mask)
        for i, (camera, photo) in enumerate(zip(cameras, photos, strict=True))
    )
    return sx.Dataset(views, (), sx.PointCloud(np.asarray(truth.means), np.full((60, 3), 0.5, np.float32)))


def outside_inverted(photo):
    return np.where(left_half()[..., None], photo, 255 - photo)


def test_nothing_is_learnt_from_what_is_masked():
    plain, spoiled = (sx.fit(capture(spoil), RECIPE) for spoil in (lambda photo: photo, outside_inverted))
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(spoiled), strict=True):
        assert_array_equal(a, b)
    unmasked = sx.fit(capture(outside_inverted, mask=None), RECIPE)
    assert np.any(np.asarray(unmasked.means) != np.asarray(plain.means))


def test_some_views_may_have_masks_and_others_none():
    dataset = capture()
    mixed = replace(dataset, train=(*dataset.train[:2], replace(dataset.train[2], mask=None)))
    losses = [float(progress.loss) for progress in sx.optimize(mixed, RECIPE)]
    assert np.all(np.isfinite(losses))
    assert len(losses) == 6


def test_a_mask_that_leaves_nothing_is_refused():
    with pytest.raises(DatasetError, match=r".png: its mask is entirely black"):
        sx.fit(capture(mask=lambda: np.zeros((32, 40), bool)), RECIPE)
