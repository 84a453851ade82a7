"""Captures that are wrong or unusual: training stays finite, or reports the error."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from shortened import shortened
from splatax.cameras import Camera
from splatax.errors import DatasetError
from splatax.gaussians import broken
from splatax.training.initialize import FromPoints, InFrusta
from training.test_training import SIZE, capture


def with_photo(dataset, pixels):
    return replace(dataset, train=(replace(dataset.train[0], pixels=lambda: pixels), *dataset.train[1:]))


def all_black(dataset):
    return with_photo(dataset, np.zeros((SIZE[1], SIZE[0], 3), np.uint8))


def all_transparent(dataset):
    return with_photo(dataset, np.zeros((SIZE[1], SIZE[0], 4), np.uint8))


def nothing_but_black(dataset):
    pixels = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    return replace(dataset, train=tuple(replace(view, pixels=lambda: pixels) for view in dataset.train))


def nothing_but_transparent(dataset):
    pixels = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    return replace(dataset, train=tuple(replace(view, pixels=lambda: pixels) for view in dataset.train))


def one_photo(dataset):
    return replace(dataset, train=dataset.train[:1], test=())


def one_point(dataset):
    return replace(dataset, points=sx.PointCloud(*(a[:1] for a in arrays(dataset))))


def cameras_at_one_place(dataset):
    def moved(view):
        pose = view.camera.cam_from_world.at[:3, 3].set(-view.camera.rotation @ jnp.array([0.0, 0.4, -4.0]))
        return replace(view, camera=replace(view.camera, cam_from_world=pose))

    return replace(dataset, train=tuple(moved(view) for view in dataset.train))


def cameras_at_the_only_point(dataset):
    def moved(view):
        pose = view.camera.cam_from_world.at[:3, 3].set(0)
        return replace(view, camera=replace(view.camera, cam_from_world=pose))

    points = sx.PointCloud(np.zeros((20, 3), np.float32), np.full((20, 3), 0.5, np.float32))
    return replace(dataset, train=tuple(moved(view) for view in dataset.train), points=points)


def points_all_equal(dataset):
    positions, colors = arrays(dataset)
    return replace(dataset, points=sx.PointCloud(np.zeros_like(positions), colors))


def points_behind_the_cameras(dataset):
    positions, colors = arrays(dataset)
    return replace(dataset, points=sx.PointCloud(positions - np.float32([0, 0, 50]), colors))


def scaled(factor):
    def scale(dataset):
        def scaled_camera(camera: Camera) -> Camera:
            pose = camera.cam_from_world.at[:3, 3].multiply(factor)
            return replace(camera, cam_from_world=pose)

        positions, colors = arrays(dataset)
        views = tuple(replace(view, camera=scaled_camera(view.camera)) for view in dataset.train)
        points = sx.PointCloud((positions * factor).astype(np.float32), colors)
        return replace(dataset, train=views, points=points)

    scale.__name__ = f"scaled_by_{factor:g}"
    return scale


def arrays(dataset):
    return dataset.points.positions, dataset.points.colors


FAULTS = [
    all_black,
    all_transparent,
    nothing_but_black,
    nothing_but_transparent,
    one_photo,
    one_point,
    cameras_at_one_place,
    points_all_equal,
    scaled(1e-2),
    scaled(1e5),
]

UNSEEN = [points_behind_the_cameras, cameras_at_the_only_point, scaled(1e-4)]


def named(fault):
    return fault.__name__


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["default", "classic"])  # all parts of the others but noise and discs
@pytest.mark.parametrize("fault", FAULTS, ids=named)
def test_training_stays_finite(fault, recipe):
    assert_stays_finite(fault, recipe)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["mcmc", "2dgs"])
@pytest.mark.parametrize("fault", [one_photo, points_all_equal, scaled(1e5)], ids=named)
def test_training_with_noise_and_with_discs_stays_finite(fault, recipe):
    assert_stays_finite(fault, recipe)


def assert_stays_finite(fault, recipe):
    losses, short = [], shortened(recipe)
    short = replace(short, density=replace(short.density, max_gaussians=1000))  # compiles one program
    for progress in sx.optimize(fault(capture()), short):
        losses.append(float(progress.loss))
        if progress.step % 5 == 0:
            assert not broken(progress.gaussians).any()
    assert np.isfinite(losses).all()


@pytest.mark.parametrize("fault", UNSEEN, ids=named)
@pytest.mark.parametrize("initialization", [FromPoints(), InFrusta(count=200)])
def test_a_start_that_no_camera_sees_is_refused(fault, initialization):
    recipe = replace(shortened("classic"), initialization=initialization)
    if isinstance(initialization, InFrusta) and not fault.__name__.startswith("scaled"):
        next(sx.optimize(fault(capture()), recipe))  # it needs no points
        return
    with pytest.raises(DatasetError, match=r"No camera sees any .* nearer than 0\.01 world units"):
        next(sx.optimize(fault(capture()), recipe))


def test_the_size_of_the_world_does_not_matter():
    """But for rounding, which refinements amplify: the first comes after 5 steps."""
    losses, counts = [], []
    for factor in (1, 1e5):
        steps = list(sx.optimize(scaled(factor)(capture()), shortened("classic")))
        losses.append([float(progress.loss) for progress in steps[:5]])
        counts.append(steps[-1].count)
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    assert counts[1] == counts[0]
