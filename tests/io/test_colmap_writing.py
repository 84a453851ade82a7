"""Cameras written as a COLMAP model are read back as they were."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pycolmap
from numpy.testing import assert_allclose
from PIL import Image

import splatax as sx
from captures import write_capture
from scenes import camera_at
from splatax.dataset import PointCloud, View, photos_in
from splatax.io.datasets import colmap_writing
from splatax.math import rigid
from splatax.reconstruction.panoramas import FACES


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


def panorama(name, twist, faces):
    """The faces of a 360-degree photo, as `reconstruct` names them."""
    pose = rigid.exponential(jnp.asarray(twist, jnp.float32))
    camera = camera_at((0.0, 0.0, -4.0))
    for face in faces:
        turn = jnp.eye(4).at[:3, :3].set(jnp.array(face.rotation, jnp.float32))
        turned = replace(camera, cam_from_world=turn @ pose)
        yield View(f"{name}-{face.name}.png", turned, pixels=lambda: None, face_of=name)


def written_and_read(views, folder):
    """The capture of views that were written, with blank photos."""
    colmap_writing.save(folder, views, PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.float32)))
    (folder / "images").mkdir()
    for view in views:
        size = (view.camera.width, view.camera.height)
        Image.new("RGB", size).save(folder / "images" / view.name)
    return sx.load_dataset(folder)


def test_faces_of_panoramas_are_one_photo_again_beside_ordinary_photos(tmp_path):
    twists = np.random.default_rng(0).normal(size=(4, 6))
    views = [
        view
        for number, twist in enumerate(twists[:3])
        for view in panorama(f"pano{number}.jpg", twist, FACES[: 6 - number // 2])  # the last lacks a face
    ]
    alone = replace(views[0], name="alone.png", face_of=None)
    views.insert(6, alone)
    back = written_and_read(views, tmp_path)
    assert photos_in(back.views) == 4
    expected = {view.name: view for view in views}
    assert {view.name: view.photo for view in back.views} == {v.name: v.photo for v in views}
    for view in back.views:
        assert_allclose(view.camera.cam_from_world, expected[view.name].camera.cam_from_world, atol=2e-6)


def test_panoramas_of_one_camera_share_a_rig(tmp_path):
    twists = np.random.default_rng(1).normal(size=(3, 6))
    views = [view for i, twist in enumerate(twists) for view in panorama(f"{i}.jpg", twist, FACES)]
    written_and_read(views, tmp_path)
    model = pycolmap.Reconstruction(tmp_path / colmap_writing.PLACE)
    assert (len(model.rigs), len(model.cameras), len(model.frames)) == (1, 6, 3)
