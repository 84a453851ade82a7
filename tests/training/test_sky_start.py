"""Gaussians in the sky from the start: far around the cameras, where they look."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from splatax.cameras import rig
from splatax.cameras.geometry import seen_at
from splatax.errors import DatasetError
from splatax.training.initialize import Discs, FromPoints, WithSky, evenly_on_sphere, with_sky
from training.test_training import capture


def test_gaussians_of_the_sky_are_far_around_the_cameras_and_the_others_as_without():
    dataset, start = capture(), FromPoints(opacity=0.5)
    plain, gaussians = start(dataset, 1, 0), WithSky(start, count=400, radius=20.0)(dataset, 1, 0)
    means = np.asarray(gaussians.means, np.float64)
    assert_array_equal(means[: len(plain)], plain.means)
    assert_array_equal(gaussians.sh[: len(plain)], plain.sh)
    centre = rig.positions_of([view.camera for view in dataset.train]).mean(axis=0)
    distances = np.linalg.norm(means[len(plain) :] - centre, axis=1)
    assert_allclose(distances, 20 * dataset.extent, rtol=1e-5)


def test_every_photo_shows_gaussians_of_the_sky_and_none_is_outside_all_photos():
    dataset, start = capture(), FromPoints()
    sky = np.asarray(WithSky(start)(dataset, 0, 0).means)[len(start(dataset, 0, 0)) :]
    inside = []
    for view in dataset.train:
        pixels, _ = seen_at(view.camera, sky)
        inside.append(((pixels >= 0) & (pixels < [view.camera.width, view.camera.height])).all(axis=1))
    assert all(rows.any() for rows in inside)
    assert np.any(inside, axis=0).all()


def test_points_on_the_sphere_are_spread_evenly():
    points = evenly_on_sphere(500)
    assert_allclose(np.linalg.norm(points, axis=1), 1)
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 9 * np.eye(len(points))
    # In a square lattice of 500 points on the area 4 pi, neighbours are 0.159 apart.
    assert apart.min() > 0.75 * 0.159
    assert apart.min(axis=1).max() < 1.25 * 0.159


def test_a_sky_of_discs_is_of_discs():
    gaussians = with_sky(Discs(FromPoints()))(capture(), 0, 0)
    assert np.all(np.isneginf(gaussians.log_scales[:, 2]))
    assert len(gaussians) > len(FromPoints()(capture(), 0, 0))


def test_a_capture_whose_points_no_camera_sees_is_refused_with_a_sky_too():
    dataset = capture()
    view = dataset.train[0]
    forward = np.asarray(view.camera.cam_from_world)[2, :3]
    behind = rig.positions_of([view.camera]) - forward - 0.1 * dataset.points.positions
    points = replace(dataset.points, positions=behind.astype(np.float32))
    hidden = replace(dataset, train=(view,), points=points)
    with pytest.raises(DatasetError, match="No camera sees"):
        WithSky(FromPoints())(hidden, 0, 0)


def test_gaussians_of_the_sky_are_as_large_as_on_the_whole_sphere_however_few_a_camera_sees():
    dataset, start = capture(), FromPoints()
    one = replace(dataset, train=dataset.train[:1])
    sizes = np.exp(np.asarray(WithSky(start)(one, 0, 0).log_scales))[len(start(one, 0, 0)) :]
    apart = 30 * one.extent * math.sqrt(4 * math.pi / 500)
    assert len(sizes)
    assert np.all((sizes > 0.25 * apart) & (sizes < apart))
