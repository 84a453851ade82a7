"""Cameras written as a COLMAP model are read back as they were."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

import splatax as sx
from captures import write_capture
from splatax.io.datasets import colmap_writing
from splatax.math import rigid


def test_cameras_and_points_come_back(tmp_path):
    dataset = sx.load_dataset(write_capture(tmp_path / "capture"))
    twists = jnp.asarray(np.random.default_rng(0).normal(size=(9, 6)), jnp.float32)
    views = [
        replace(view, camera=replace(view.camera, cam_from_world=rigid.exponential(twist)))
        for view, twist in zip(dataset.views, twists, strict=True)
    ]
    camera = views[3].camera
    views[3] = replace(views[3], camera=replace(camera, fx=camera.fx * 1.1))
    colmap_writing.save(tmp_path / "refined", views, dataset.points)
    (tmp_path / "refined" / "images").symlink_to(tmp_path / "capture" / "images")
    back = sx.load_dataset(tmp_path / "refined")
    assert [view.name for view in back.test] == [view.name for view in dataset.test]
    for ours, theirs in zip(back.views, views, strict=True):
        assert ours.name == theirs.name
        assert_allclose(ours.camera.cam_from_world, theirs.camera.cam_from_world, atol=1e-6)
        for number in ("fx", "fy", "cx", "cy"):
            assert getattr(ours.camera, number) == getattr(theirs.camera, number)
    ours, theirs = (cloud.positions[:, 0].argsort() for cloud in (back.points, dataset.points))
    assert_allclose(back.points.positions[ours], dataset.points.positions[theirs], atol=1e-6)
    assert np.abs(back.points.colors[ours] - dataset.points.colors[theirs]).max() < 1 / 255
