"""Cameras from and to the conventions of other programs, and the pinholes that viewers show for them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import camera_at
from splatax import cameras
from splatax.cameras import RollingShutter, as_pinhole
from splatax.cameras.conventions import COLMAP_MODELS, PANORAMA
from splatax.cameras.geometry import points_at, seen_at
from splatax.cameras.lenses import Fisheye, FTheta, Orthographic, Pinhole, opencv
from splatax.math import rigid
from splatax.trajectories import Keyframe
from splatax.viewer.poses import pose_of as viewer_pose
from splatax.web.staging import pose_of as page_pose

SIZE = (64, 48)
K = np.array([[50.0, 0, 31], [0, 52, 25], [0, 0, 1]])
COEFFICIENTS = {  # of COLMAP's models, after focal lengths and principal point
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.2],
    "RADIAL": [-0.2, 0.05],
    "OPENCV": [-0.2, 0.05, 0.003, -0.002],
    "FULL_OPENCV": [-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.005],
    "FOV": [0.9],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "SIMPLE_RADIAL_FISHEYE": [0.02],
    "RADIAL_FISHEYE": [0.02, -0.01],
    "OPENCV_FISHEYE": [0.02, -0.01, 0.003, -0.0004],
    "THIN_PRISM_FISHEYE": [0.02, -0.01, 0.003, -0.002, 0.003, -0.0004, 0.004, 0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(0.02, -0.01, 0.003, -0.0004, 1e-4, -1e-5),
        *(0.003, -0.002, 0.004, 0.001, -0.002, 0.003),
    ],
}
LENSES = {
    "pinhole": (Pinhole(), None),
    "opencv": (opencv(-0.2, 0.05), None),
    "fisheye": (Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004])), None),
    "rolling shutter": (Pinhole(), RollingShutter(jnp.array([0.02, -0.03, 0.05, 0.06, 0.02, -0.04]))),
    "panorama": None,
}


def pose(seed=0):
    twist = np.random.default_rng(seed).normal(size=6)
    return rigid.exponential(jnp.asarray(twist, jnp.float32))


def camera_with(name):
    if name == "panorama":
        return cameras.panorama(pose(), 96, 48)
    lens, motion = LENSES[name]
    return replace(camera_at((0.4, -0.3, -4.0), size=SIZE, focal=45.0), lens=lens, motion=motion)


def assert_equal_cameras(one, other, tolerance=1e-6):
    assert (one.width, one.height) == (other.width, other.height)
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert_allclose(a, b, rtol=tolerance, atol=tolerance)


def test_every_model_of_colmap_has_coefficients_here():
    assert COEFFICIENTS.keys() == COLMAP_MODELS.keys()


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_a_camera_of_colmap_and_the_one_written_for_it_see_points_where_colmap_does(model):
    """The model that is written may be a larger one that holds the same lens."""
    pycolmap = pytest.importorskip("pycolmap")
    focals = [50.0] if COLMAP_MODELS[model].focals == 1 else [50.0, 52.0]
    parameters = [*focals, 31.0, 25.0, *COEFFICIENTS[model]]
    given = pycolmap.Camera(model=model, width=64, height=48, params=parameters)
    ours = cameras.from_colmap(model, parameters, *SIZE, jnp.eye(4))
    name, numbers = cameras.to_colmap(ours)
    written = pycolmap.Camera(model=name, width=64, height=48, params=numbers)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (100, 2)), np.ones(100)]) * rng.uniform(1, 9, (100, 1))
    expected = np.asarray(given.img_from_cam(points))
    assert_allclose(seen_at(ours, points)[0], expected, atol=1e-4)  # float32
    assert_allclose(np.asarray(written.img_from_cam(points)), expected, atol=1e-4)
    assert_equal_cameras(cameras.from_colmap(name, numbers, *SIZE, jnp.eye(4)), ours)


def test_a_panorama_of_colmap_comes_back():
    ours = cameras.panorama(pose(), 96, 48)
    model, numbers = cameras.to_colmap(ours)
    assert model == PANORAMA
    assert_equal_cameras(cameras.from_colmap(model, numbers, 96, 48, ours.cam_from_world), ours)


@pytest.mark.parametrize(
    ("lens", "motion"),
    [
        (Orthographic(), None),
        (FTheta(jnp.zeros(4), jnp.float32(1.5)), None),
        (opencv(*[0.0] * 8, 0.01), None),  # COLMAP has no thin prism of a perspective
        (Pinhole(), RollingShutter(jnp.zeros(6))),
    ],
)
def test_what_colmap_has_no_camera_for_is_refused(lens, motion):
    camera = replace(camera_at(), lens=lens, motion=motion)
    with pytest.raises(ValueError, match="COLMAP"):
        cameras.to_colmap(camera)
    with pytest.raises(ValueError, match="no lens for COLMAP's camera model"):
        cameras.from_colmap("ROUND", [1.0], 8, 8, jnp.eye(4))


@pytest.mark.parametrize("lens", [Pinhole(), opencv(-0.1, 0.02)])
def test_matrices_of_opencv_and_opengl_come_back(lens):
    intrinsics = jnp.asarray(K, jnp.float32)
    camera = cameras.from_opencv(intrinsics, pose(), *SIZE, lens)
    matrices = cameras.to_opencv(camera)
    assert_allclose(matrices[0], K)
    assert_allclose(matrices[1], pose())
    assert_equal_cameras(cameras.from_opencv(*matrices, *SIZE, lens), camera)
    assert_equal_cameras(cameras.from_opengl(*cameras.to_opengl(camera), *SIZE, lens), camera)


def test_a_camera_of_opengl_looks_along_minus_z_with_y_up():
    """As Blender's and nerfstudio's: camera to world, so its place is the last column."""
    place = jnp.array([1.0, 2.0, 3.0])
    camera = cameras.from_opengl(jnp.asarray(K, jnp.float32), jnp.eye(4).at[:3, 3].set(place), *SIZE)
    assert_allclose(camera.position, place, atol=1e-6)
    there = np.asarray(place) + [[0, 0, -5], [0, 1, -5], [1, 0, -5], [0, 0, 5]]
    pixels, depths = seen_at(camera, there)
    assert_allclose(pixels[:3], [[31, 25], [31, 25 - 52 / 5], [31 + 50 / 5, 25]], rtol=1e-6)
    assert_allclose(depths[:3], 5)
    assert np.isnan(depths[3])


def ahead_of(camera):
    """Points at the camera's axis and near it, in the world."""
    middle = np.array([[float(camera.cx), float(camera.cy)]])
    return points_at(camera, middle + [[0, 0], [0.5, 0], [0, 0.5]], np.full(3, 3.0))


@pytest.mark.parametrize("name", LENSES)
def test_a_viewer_shows_a_pinhole_at_the_same_place_with_the_same_middle(name):
    camera = camera_with(name)
    shown = as_pinhole(camera)
    assert isinstance(shown.lens, Pinhole)
    assert shown.motion is None
    assert_allclose(shown.cam_from_world, camera.cam_from_world)
    still = replace(camera, motion=None)
    scale = float(shown.fx / camera.fx)  # distortion vanishes at the middle, up to the change of focal length
    places = seen_at(shown, ahead_of(still))[0] - np.asarray(shown.center)
    expected = seen_at(still, ahead_of(still))[0] - np.asarray(camera.center)
    scales = np.array([scale, float(shown.fy / camera.fy)])
    assert_allclose(places, expected * scales, atol=1e-3)
    if name in ("opencv", "rolling shutter", "pinhole"):
        assert_allclose(scales, 1)
    if name == "panorama":
        wide = 2 * np.degrees(np.arctan(shown.width / 2 / float(shown.fx)))
        assert wide == pytest.approx(90)


@pytest.mark.parametrize("name", LENSES)
def test_page_film_and_viewer_look_where_the_camera_does(name):
    """Each has its own convention of poses; a point on the camera's axis is ahead of all of them."""
    camera = camera_with(name)
    shown = as_pinhole(camera)
    (ahead, *_) = ahead_of(replace(camera, motion=None))
    eye = np.asarray(camera.position, np.float64)
    film = Keyframe.of(camera, SIZE).camera(SIZE)
    window = viewer_pose(camera, SIZE).camera(SIZE)
    for other in (film, window):
        assert_allclose(other.position, eye, atol=1e-5)
        direction = np.asarray(other.rotation) @ (ahead - eye)
        assert_allclose(direction / np.linalg.norm(direction), [0, 0, 1], atol=1e-5)
    # A film never shows more than the pinhole, a window never less.
    assert float(film.fy) * camera.height >= float(shown.fy) * SIZE[1] * (1 - 1e-5)
    assert float(window.fy) * camera.height <= float(shown.fy) * SIZE[1] * (1 + 1e-5)
    page = page_pose(camera, 2.0)
    x, y, z, w = page["quaternion"]
    forward = -np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    there = np.array([1, -1, -1]) * (ahead - eye)  # the page has y up
    assert_allclose(forward, there / np.linalg.norm(there), atol=1e-5)
    assert_allclose(page["position"], np.array([1, -1, -1]) * eye, atol=1e-5)
    assert page["lens"]["fx"] == pytest.approx(2 * float(shown.fx) / camera.width, rel=1e-6)
