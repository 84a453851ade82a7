"""Frames of colour and depth, and searches for the pose of a part in them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import splatax as sx
from scenes import camera_at, plane_of_gaussians, random_gaussians
from splatax.cameras import panorama
from splatax.cameras.lenses import Fisheye
from splatax.sensors import Depth, observe
from splatax.transforms import Similarity
from splatax.twins import LocationSearch, RgbdFrame, located

WIDTH, HEIGHT = 6, 4


def test_the_points_of_a_frame_lie_where_its_camera_measured_them():
    pose = sx.look_at(jnp.array([1.0, -2.0, 0.5]), jnp.array([0.2, 0.1, 0.3]), jnp.array([0.0, 0.0, 1.0]))
    camera = sx.Camera.simple_pinhole(5.0, pose, WIDTH, HEIGHT)
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[1, 4], depth[3, 0], depth[2, 2], depth[0, 1] = 1.5, 2.5, np.nan, np.inf
    points = RgbdFrame(camera, np.zeros((HEIGHT, WIDTH, 3), np.float32), depth).points()
    matrix = np.asarray(pose, np.float64)
    local = points @ matrix[:3, :3].T + matrix[:3, 3]
    # The principal point is the middle of the image, and pixel centres are at halves.
    expected = [
        [(4.5 - 3) / 5 * 1.5, (1.5 - 2) / 5 * 1.5, 1.5],
        [(0.5 - 3) / 5 * 2.5, (3.5 - 2) / 5 * 2.5, 2.5],
    ]
    assert_allclose(local, expected, atol=1e-5)


def wide(size: int) -> sx.Camera:
    """A fisheye whose corners look 68 degrees away from its axis."""
    pose = camera_at((0.2, -0.1, -1.0)).cam_from_world
    return replace(sx.Camera.simple_pinhole(0.6 * size, pose, size, size), lens=Fisheye(jnp.zeros(4)))


@pytest.mark.parametrize("along", ["axis", "ray"])
def test_the_points_of_a_fisheye_frame_lie_where_its_depth_camera_measured_them(along):
    camera = wide(HEIGHT)
    depth = np.zeros((HEIGHT, HEIGHT), np.float32)
    depth[0, 3] = 2.0
    (point,) = RgbdFrame(camera, np.zeros((HEIGHT, HEIGHT, 3)), depth, along).points()
    local = np.asarray(camera.cam_from_world, np.float64) @ np.append(point, 1)
    offset = (np.array([3.5, 0.5]) - HEIGHT / 2) / (0.6 * HEIGHT)  # the angle from the axis, radians
    angle = np.linalg.norm(offset)
    ray = np.append(np.sin(angle) / angle * offset, np.cos(angle))
    expected = 2.0 * ray / (ray[2] if along == "axis" else 1)
    assert_allclose(local[:3], expected, atol=1e-5)


@pytest.mark.parametrize("lens", ["fisheye", "panorama"])
@pytest.mark.parametrize("along", ["axis", "ray"])
def test_depth_images_of_wide_cameras_have_their_points_on_the_surface(lens, along):
    wall = plane_of_gaussians(np.array([0.0, 0.0, -1.0]), n=2000, half=3.0, sigma=0.06)  # at z = 0
    camera = wide(32) if lens == "fisheye" else panorama(wide(32).cam_from_world, 64, 32)
    depth = observe(wall, camera, {"depth": Depth(along=along)})["depth"]
    points = RgbdFrame(camera, np.zeros((camera.height, camera.width, 3)), depth, along).points()
    assert len(points) > 100
    # Renderings of grazing rays are less exact. With z taken for the distance, half are more than 0.1 off.
    assert np.median(np.abs(points[:, 2])) < 0.03


@pytest.mark.slow
def test_a_part_is_found_in_a_frame_of_a_fisheye():
    part = sx.Part(random_gaussians(n=150, degree=0), Similarity.of(move=(0.4, -0.3, 2.0)))
    scene, camera = sx.Scene({"cup": part}), wide(48)
    seen = sx.render(scene, camera, background=sx.BLACK).rgb
    depth = observe(scene, camera, {"depth": Depth()})["depth"]
    turn = Rotation.from_rotvec([0.05, -0.08, 0.04]).as_matrix()
    wrong = scene.posed({"cup": Similarity(turn, np.array([0.5, -0.35, 2.1]))})
    with jax.numpy_dtype_promotion("standard"):  # the optimizer counts its steps in integers
        found = located(wrong, "cup", RgbdFrame(camera, seen, depth), LocationSearch(steps=100))
    assert_allclose(found.translation, [0.4, -0.3, 2.0], atol=0.02)
    assert Rotation.from_matrix(np.asarray(found.rotation)).magnitude() < 0.02
