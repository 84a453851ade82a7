"""The reprojection check of captures that are distorted, undistorted, panoramas, or exposed row by row."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from captures import pinhole, write_capture
from splatax.cameras import RollingShutter
from splatax.cameras.geometry import seen_at
from splatax.io.datasets.colmap import registered_in
from splatax.io.datasets.reprojection import observed_at, reprojection_errors

CAMERAS = {
    "OPENCV": ((64, 48), [50.0, 52.0, 31.0, 25.0, -0.2, 0.05, 0.003, -0.002]),
    "OPENCV_FISHEYE": ((64, 48), [50.0, 52.0, 31.0, 25.0, 0.02, -0.01, 0.003, -0.0004]),
    "EQUIRECTANGULAR": ((96, 48), [96.0, 48.0]),
}


def calibrated(model):
    (width, height), parameters = CAMERAS[model]
    return pycolmap.Camera(model=model, width=width, height=height, params=parameters, camera_id=1)


def capture_of(model, folder):
    return write_capture(folder / "capture", camera=calibrated(model), size=CAMERAS[model][0])


def shifted(capture):
    """The capture with all observations five pixels off."""
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + [3, 4]
    model.write_binary(capture / "sparse" / "0")
    return capture


def note_of(dataset):
    (note,) = [note for note in dataset.notes if "reprojection" in note]
    return note


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("downscale", [1, 2])
def test_photos_as_they_are_have_the_errors_of_their_observations(tmp_path, model, downscale):
    capture = capture_of(model, tmp_path)
    assert "median reprojection error 0.00 px" in note_of(sx.load_dataset(capture, downscale=downscale))
    off = sx.load_dataset(shifted(capture), downscale=downscale)
    assert f"median reprojection error {5 / downscale:.2f} px" in note_of(off)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_observations_move_with_the_pixels_of_an_undistorted_photo(tmp_path, model):
    dataset = sx.load_dataset(capture_of(model, tmp_path), undistort=True)
    assert "median reprojection error 0.00 px" in note_of(dataset)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("undistort", [False, True])
def test_an_observation_is_where_the_camera_of_the_view_sees_its_point(tmp_path, model, undistort):
    camera = sx.load_dataset(capture_of(model, tmp_path), undistort=undistort).views[0].camera
    camera = replace(camera, cam_from_world=jnp.eye(4)).resized(32, 24)
    points = np.random.default_rng(0).uniform([-1, -0.8, 4], [1, 0.8, 6], (50, 3))
    pixels = np.asarray(calibrated(model).img_from_cam(points))
    assert_allclose(observed_at(calibrated(model), pixels, camera), seen_at(camera, points)[0], atol=1e-3)


def test_a_camera_that_moves_sees_each_observation_when_its_row_is_exposed(tmp_path):
    capture = write_capture(tmp_path / "capture", camera=pinhole())
    motion = RollingShutter(jnp.array([0.04, -0.06, 0.1, 0.12, 0.04, -0.08]))
    still = {view.name: view.camera for view in sx.load_dataset(capture).views}
    moving = {name: replace(camera, motion=motion) for name, camera in still.items()}
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    registered = registered_in(capture, model)
    for name, image in registered.items():
        points = np.array([model.point3D(point.point3D_id).xyz for point in image.points2D])
        for point, place in zip(image.points2D, seen_at(moving[name], points)[0], strict=True):
            point.xy = place
    exact = reprojection_errors(model, registered, moving)
    ignored = reprojection_errors(model, registered, still)
    assert exact.keys() == still.keys()
    assert max(errors.max() for errors in exact.values()) < 1e-3
    assert min(errors.max() for errors in ignored.values()) > 0.5
