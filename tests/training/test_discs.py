"""The recipe `2dgs`: discs stay discs, find surfaces, and are saved as such."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, plane_of_gaussians
from splatax.drawn import Seen
from splatax.gaussians import joined
from splatax.stages import project
from splatax.training import geometry
from splatax.training.disc_geometry import DiscGeometry
from splatax.training.geometry import LAYERS
from splatax.training.objectives import TrainingView

NORMAL = np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])


def penalty(scene, camera, parts, progress=1.0):
    kernels = sx.backends.resolve("auto")
    splats = project(scene, camera, low_pass=sx.AlongRays(), backend="auto")
    seen = Seen(splats, scene, camera, kernels=sx.backends.resolve("auto"))
    images = geometry.drawn(parts.outputs, geometry.channels(parts.outputs, seen), seen, kernels)
    return parts(images, TrainingView(camera, None, jnp.asarray(progress)))


def cloud_of_discs():
    plane = plane_of_gaussians(NORMAL, n=300, sigma=0.2, flat=1e-12)
    offsets = np.random.default_rng(0).normal(size=(300, 3)) * 0.3
    return replace(plane, means=plane.means + jnp.asarray(offsets, jnp.float32))


@pytest.mark.slow
def test_distortion_is_the_sum_over_pairs_of_discs():
    camera = camera_at((0.0, 0.0, -4.0), size=(9, 7), focal=10.0)
    facing = plane_of_gaussians(np.array([0.0, 0.0, -1.0]), n=3, half=0.1, sigma=3.0, flat=1e-12, opacity=0.6)
    scene = replace(facing, means=facing.means.at[:, 2].set(jnp.array([0.0, 1.0, 3.0])))
    outputs = {"layers": LAYERS}
    splats = project(scene, camera, low_pass=sx.AlongRays(), backend="auto")
    seen = Seen(splats, scene, camera, kernels=sx.backends.resolve("auto"))
    drawn = geometry.drawn(outputs, geometry.channels(outputs, seen), seen, sx.backends.resolve("auto"))
    at = sx.render(
        scene, camera, low_pass=sx.AlongRays(), outputs=("contributors",), backend="auto"
    ).contributors
    weights = np.zeros((7, 9, 3))
    np.put_along_axis(weights, np.asarray(at.indices[..., :3]), np.asarray(at.weights[..., :3]), axis=2)
    near = 1 / np.array([4.0, 5.0, 7.0])  # inverse depths
    mean = weights @ near / weights.sum(axis=-1)
    expected = sum(
        weights[..., i] * weights[..., j] * ((near[i] - near[j]) / mean) ** 2
        for i in range(3)
        for j in range(i)
    )
    assert_allclose(drawn["layers"].scatter, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_a_plane_of_discs_has_no_penalty_and_a_cloud_has_one():
    camera = camera_at((0.4, -0.3, -4.0), size=(24, 18), focal=30.0)
    plane, cloud = plane_of_gaussians(NORMAL, n=300, sigma=0.2, flat=1e-12), cloud_of_discs()
    for parts in (DiscGeometry(consistency=0.0), DiscGeometry(distortion=0.0)):
        assert penalty(plane, camera, parts) < 0.05 * penalty(cloud, camera, parts)
        assert penalty(cloud, camera, parts, progress=0.05) == 0


def test_discs_have_no_penalty_until_the_first_of_both_begins():
    scene, camera = cloud_of_discs(), camera_at((0.0, 0.0, -4.0), size=(9, 7), focal=10.0)
    for distortion, consistency in ((0.2, 0.6), (0.6, 0.2)):
        parts = DiscGeometry(distortion_from=distortion, consistency_from=consistency)
        assert parts.after == 0.2
        assert penalty(scene, camera, parts, 0.19) == 0
        assert penalty(scene, camera, parts, 0.2) > 0


def test_the_distortion_does_not_depend_on_the_unit_of_length():
    cloud = cloud_of_discs()
    larger = replace(cloud, means=10 * cloud.means, log_scales=cloud.log_scales + np.log(10))
    camera = camera_at((0.4, -0.3, -4.0), size=(24, 18), focal=30.0)
    farther = camera_at((4.0, -3.0, -40.0), size=(24, 18), focal=30.0)
    parts = DiscGeometry(consistency=0.0)
    assert_allclose(penalty(larger, farther, parts), penalty(cloud, camera, parts), rtol=1e-3)


@pytest.mark.slow
def test_a_speck_in_front_of_the_camera_hardly_moves_the_surface_behind_it():
    """A wall of inverse depth d and weight 1 - w behind a speck of 1 / z >> d has the relative gradient

    2 w (1 - w) d / z / (w / z + (1 - w) d)^2 <= 1 / 2.
    """
    camera = camera_at((0.0, 0.0, -4.0), size=(12, 9), focal=15.0)
    wall = plane_of_gaussians(np.array([0.0, 0.0, -1.0]), n=1, sigma=50.0, flat=1e-12, opacity=0.95)
    speck = replace(
        wall,
        means=jnp.array([[0.0, 0.0, -3.97]]),
        log_scales=wall.log_scales - np.log(10),
        opacity_logits=jnp.array([-1.0]),
    )

    def at(depth):  # of the wall, relative to its true one
        both = joined([replace(wall, means=wall.means.at[:, 2].set(4 * depth - 4)), speck])
        return penalty(both, camera, DiscGeometry(consistency=0.0))

    assert 0 < abs(jax.grad(at)(1.0)) < 0.1


@pytest.mark.slow
def test_trained_discs_are_flat_and_drawn_along_rays_from_their_file(tmp_path):
    dataset = sx.demo_dataset()
    small = dataset.train[:6]
    recipe = sx.recipes.discs(steps=60, max_gaussians=3_200)
    scene = sx.fit(replace(dataset, train=small), replace(recipe, sh=replace(recipe.sh, degree=0)))
    assert len(scene) > 3_000
    assert np.isneginf(scene.log_scales[:, 2]).all()
    assert np.isfinite(scene.log_scales[:, :2]).all()
    sx.save(tmp_path / "scene.ply", scene)
    loaded = sx.load(tmp_path / "scene.ply")
    assert loaded.low_pass == sx.AlongRays()
    camera = dataset.test[0].camera.resized(60, 40)
    assert_allclose(*(np.asarray(sx.render(s, camera).rgb) for s in (scene, loaded)), atol=1e-6)
    first = sx.render(sx.recipes.discs().initialization(dataset, 0, 0), camera, low_pass=sx.AlongRays()).rgb
    photo = jax.image.resize(jnp.asarray(dataset.test[0].pixels()[..., :3]) / 255, (40, 60, 3), "linear")
    before, after = (
        float(jnp.mean(jnp.abs(image - photo))) for image in (first, sx.render(loaded, camera).rgb)
    )
    assert after < 0.7 * before
