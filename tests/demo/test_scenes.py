"""Every synthetic scene makes a capture, and the true geometry of the ray caster is that of its photos."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from splatax.demo.raycast import SAMPLES, look, photograph, truth
from splatax.demo.scene import Light, Scene
from splatax.demo.scenes import SCENES
from splatax.demo.shapes import Rectangle, Sphere
from splatax.demo.textures import Surface, plain
from splatax.demo.viewpoints import Orbit, Outward

SMALL = (48, 36)
GREY = Surface(Sphere((0.0, 0.0, 0.0), 1.0), plain(0.5, 0.5, 0.5))
LIGHT = Light((0.0, -50.0, 0.0))


def alone(surface, sky=None):
    """A scene of one surface, seen from 4 units in front of the origin along y."""
    return Scene("", (surface,), LIGHT, Orbit((0, 0, 0), 4.0, elevations=(0.0,)), sky=sky)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_by_name_is_a_capture_with_points_that_its_cameras_see(name):
    dataset = sx.demo_dataset(photos=3, width=SMALL[0], height=SMALL[1], scene=name)
    assert len(dataset.views) == 3
    assert len(dataset.points) > 100
    seen = np.zeros(len(dataset.points), bool)
    for view in dataset.views:
        local = np.asarray(dataset.points.positions) @ np.asarray(view.camera.rotation).T
        x, y, z = (local + np.asarray(view.camera.translation)).T
        u, v = x / z * float(view.camera.fx) + SMALL[0] / 2, y / z * float(view.camera.fy) + SMALL[1] / 2
        seen |= (z > 0) & (u > 0) & (v > 0) & (u < SMALL[0]) & (v < SMALL[1])
    assert seen.all()


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_photos_are_neither_black_nor_white_nor_flat(name):
    scene = SCENES[name]
    for camera in scene.cameras(2, SMALL):
        photo = np.asarray(photograph(camera, scene))
        assert photo.shape == (SMALL[1], SMALL[0], 3 if scene.sky else 4)
        shown = photo[..., :3][photo[..., -1] > 0] if scene.sky is None else photo
        assert 30 < shown.mean() < 225
        assert shown.std() > 10


def test_an_unknown_scene_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"scene is one of still-life, room, .* glossy, not 'cellar'"):
        sx.demo_dataset(scene="cellar")


def test_depth_and_normals_of_a_sphere_are_exact():
    scene = alone(GREY)
    (camera,) = scene.cameras(1, (41, 31))
    exact = truth(camera, scene)
    # The central ray meets the sphere 3 units away, where the normal points at the camera.
    assert float(exact.depth[15, 20]) == pytest.approx(3, abs=1e-4)
    assert_allclose(exact.normals[15, 20], [0, -1, 0], atol=1e-4)
    on = np.asarray(exact.surfaces) == 0
    x, y = np.meshgrid(np.arange(41) + 0.5, np.arange(31) + 0.5)
    depth = np.asarray(exact.depth)[on]
    rays = np.stack([(x - 20.5) / float(camera.fx), (y - 15.5) / float(camera.fy), np.ones_like(x)], -1)[on]
    points = (rays * depth[:, None] - np.asarray(camera.translation)) @ np.asarray(camera.rotation)
    assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-4)
    assert_allclose(np.asarray(exact.normals)[on], points, atol=1e-3)  # of the unit sphere
    assert np.isinf(np.asarray(exact.depth)[~on]).all()
    assert (np.asarray(exact.surfaces)[~on] == -1).all()
    assert not np.asarray(exact.normals)[~on].any()


def test_normals_face_the_camera_also_from_inside():
    scene = Scene("", (GREY,), LIGHT, Outward((0, 0, 0), 0.5))
    for camera in scene.cameras(4, SMALL):
        exact = truth(camera, scene)
        x, y = np.meshgrid(np.arange(SMALL[0]) + 0.5, np.arange(SMALL[1]) + 0.5)
        rays = np.stack([(x - 24) / float(camera.fx), (y - 18) / float(camera.fy), np.ones_like(x)], -1)
        assert (np.asarray(exact.surfaces) == 0).all()
        assert (np.sum((rays @ np.asarray(camera.rotation)) * np.asarray(exact.normals), axis=-1) < 0).all()


def test_a_photo_without_sky_has_the_coverage_of_its_pixels_as_alpha():
    scene = alone(GREY)
    (camera,) = scene.cameras(1, SMALL)
    photo = np.asarray(photograph(camera, scene))
    assert set(np.unique(photo[..., 3])) <= {round(255 * k / SAMPLES**2) for k in range(SAMPLES**2 + 1)}
    edge = (photo[..., 3] > 0) & (photo[..., 3] < 255)
    assert edge.any()
    # Straight alpha: the colour at the edge is that of the surface, not a mixture with black.
    assert photo[edge][:, 0].min() > 0.4 * 0.5 * 255


def test_a_mirror_shows_the_sky_above_it():
    def sky(direction):
        return jnp.where(direction[2] > 0, jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0]))

    floor = Surface(Rectangle((-5, -5, 0), (10, 0, 0), (0, 10, 0)), plain(0.0, 0.0, 0.0), mirror=1.0)
    scene = Scene("", (floor,), LIGHT, Orbit((0, 0, 0), 3.0, elevations=(45.0,)), sky=sky)
    (camera,) = scene.cameras(1, SMALL)
    centre = look(camera, jnp.array([[24.0, 18.0]]), scene)
    assert_allclose(centre.color[0], [0, 0, 1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_no_two_photos_are_taken_from_one_place(name):
    positions = np.stack([np.asarray(camera.position) for camera in SCENES[name].cameras()])
    assert len(np.unique(positions.round(4), axis=0)) == SCENES[name].photos
