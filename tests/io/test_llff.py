"""LLFF's poses_bounds.npy."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from captures import POSES, write_llff
from splatax.errors import DatasetError


@pytest.fixture
def capture(tmp_path):
    return write_llff(tmp_path / "capture")


def test_poses_and_focal_length_are_those_of_the_photos(capture):
    dataset = sx.load_dataset(capture)
    for view, pose in zip(dataset.views, POSES, strict=True):
        assert_allclose(view.camera.cam_from_world, pose, atol=1e-6)
        assert (view.camera.width, view.camera.height) == (64, 48)
        assert_allclose([view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy], [60, 60, 32, 24])
    assert [view.name for view in dataset.test] == ["IMG_04.png"]
    assert not len(dataset.points)


def test_training_starts_at_random_if_asked(capture):
    dataset = sx.load_dataset(capture)
    with pytest.raises(DatasetError, match="Or start from random Gaussians"):
        next(sx.optimize(dataset, sx.Recipe(steps=1)))
    assert jax.tree.leaves(dataset.train[0].camera)


def test_a_missing_photo_is_noticed_because_order_is_all_that_binds(capture):
    (capture / "images" / "IMG_03.png").unlink()
    with pytest.raises(DatasetError, match=r"poses of 9 photos, but .*images holds 8"):
        sx.load_dataset(capture)


@pytest.mark.parametrize("damage", ["truncated", "pickled", "shape", "empty", "nan", "scaled", "text"])
def test_a_damaged_file(capture, damage):
    path = capture / "poses_bounds.npy"
    rows = np.load(path)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:300])
    elif damage == "text":
        path.write_text("no array")
    else:
        rows = {
            "pickled": np.array([{}], object),
            "shape": rows[:, :16],
            "empty": rows[:0],
            "nan": np.where(np.arange(17) == 3, np.nan, rows),
            "scaled": rows * 2,
        }[damage]
        np.save(path, rows)
    with pytest.raises(DatasetError, match=r"poses_bounds.npy: .*(again|Copy)"):
        sx.load_dataset(capture)
