"""Motions during the exposure that are written beside a COLMAP model are read back with the capture."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import splatax as sx
from captures import radial, write_capture
from splatax.cameras import RollingShutter
from splatax.errors import DatasetError
from splatax.io.datasets import motions


def moving(view, direction="down", seed=0):
    twist = jnp.asarray(np.random.default_rng(seed).normal(size=6) * 0.1, jnp.float32)
    return replace(view, camera=replace(view.camera, motion=RollingShutter(twist, direction)))


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "capture", camera=radial())


def test_motions_come_back_bit_for_bit_and_other_cameras_stand_still(capture):
    views = sx.load_dataset(capture).views
    given = {v.name: v for v in (moving(views[0]), moving(views[1], "left", 1))}
    (capture / motions.FILE).write_text(json.dumps(motions.contents_for([*given.values(), views[2]])))
    dataset = sx.load_dataset(capture)
    for view in dataset.views:
        if view.name not in given:
            assert view.camera.motion is None
            continue
        expected = given[view.name].camera.motion
        assert_array_equal(view.camera.motion.twist, expected.twist)
        assert view.camera.motion.direction == expected.direction
    assert "rolling shutter of 2 photos, from motions.json" in dataset.notes


def test_undistorted_photos_have_no_motion(capture):
    views = sx.load_dataset(capture).views
    (capture / motions.FILE).write_text(json.dumps(motions.contents_for([moving(views[0])])))
    dataset = sx.load_dataset(capture, undistort=True)
    assert all(view.camera.motion is None for view in dataset.views)
    assert any("is not used, because they are undistorted" in note for note in dataset.notes)


@pytest.mark.parametrize(
    "contents",
    [
        '{"photo01.png": [1, 2]}',
        '{"photo01.png": "fast"}',
        '{"photo01.png": [1, 2, 3, 4, 5, NaN]}',
        '{"photo01.png": {"twist": [1, 2, 3, 4, 5, 6], "direction": "inwards"}}',
        '["photo01.png"]',
        "{",
    ],
)
def test_a_damaged_file_is_named(capture, contents):
    (capture / motions.FILE).write_text(contents)
    with pytest.raises(DatasetError, match=r"motions\.json"):
        sx.load_dataset(capture)
