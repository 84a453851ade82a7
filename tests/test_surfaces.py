"""Planes of Gaussians, and normals of depth images, compared with analytic surfaces."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, plane_of_gaussians, random_gaussians
from splatax.cameras import RollingShutter, panorama
from splatax.cameras.geometry import ray
from splatax.cameras.lenses import Fisheye, Orthographic, Pinhole
from splatax.rendering import project, render
from splatax.surfaces import normals_of, pixel_centers, planes, positions_of

NORMAL = np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])  # of a plane through the origin
CAMERAS = {
    "pinhole": (Pinhole(), None),
    "fisheye": (Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004])), None),
    "orthographic": (Orthographic(), None),
    "rolling": (Pinhole(), RollingShutter(jnp.array([0.02, -0.03, 0.05, 0.06, 0.02, -0.04]))),
}


@pytest.fixture(params=CAMERAS)
def camera(request, x64):
    lens, motion = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), CAMERAS[request.param])
    camera = camera_at((0.4, -0.3, -4.0), size=(32, 24), focal=40.0, dtype=np.float64)
    if isinstance(lens, Orthographic):
        camera = replace(camera, fx=camera.fx / 4, fy=camera.fy / 4)
    return replace(camera, lens=lens, motion=motion)


def depth_of_plane(camera):
    """Depth by the lens of the plane through the origin, at the centre of each pixel."""

    def one(pixel):
        origin, direction = ray(camera, pixel)
        point = origin - direction * (NORMAL @ origin) / (NORMAL @ direction)
        return camera.lens.depth(camera.to_camera(point))

    return jax.jit(jax.vmap(jax.vmap(one)))(pixel_centers(camera.width, camera.height, camera.fx.dtype))


@pytest.mark.slow
def test_flat_gaussians_have_the_plane_that_they_lie_on(camera):
    gaussians = plane_of_gaussians(NORMAL, n=50, half=0.8, dtype=np.float64)
    splats = project(gaussians, camera, backend="reference")
    found = planes(gaussians, camera, splats)
    shown = np.asarray(splats.extents[:, 0] > 0)
    assert shown.sum() > 40
    assert_allclose(found.normals[shown], np.broadcast_to(NORMAL, (shown.sum(), 3)), atol=1e-6)
    assert_allclose(found.axes[shown], np.broadcast_to(NORMAL, (shown.sum(), 3)), atol=1e-9)

    def disparity(pixel):  # of the true plane
        origin, direction = ray(camera, pixel)
        point = origin - direction * (NORMAL @ origin) / (NORMAL @ direction)
        return 1 / camera.lens.depth(camera.to_camera(point))

    value, slope = jax.jit(jax.vmap(jax.value_and_grad(disparity)))(splats.means2d)
    assert_allclose(found.disparities[shown], value[shown], rtol=1e-6)
    # A moving camera sees the pixels beside the mean a little earlier or later.
    assert_allclose(found.slopes[shown], slope[shown], atol=1e-6 if camera.motion is None else 1e-3)


def test_a_round_gaussian_faces_the_camera():
    camera = camera_at((0.4, -0.3, -4.0))
    gaussians = replace(random_gaussians(n=20, degree=0), log_scales=jnp.full((20, 3), -3.0))
    found = planes(gaussians, camera, project(gaussians, camera))
    towards = np.asarray(camera.position) - np.asarray(gaussians.means)
    assert_allclose(found.normals, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-5)


def test_planes_stay_in_front_of_the_camera_over_all_of_their_ellipse():
    rng = np.random.default_rng(0)
    camera = camera_at((0.4, -0.3, -4.0))
    with np.errstate(divide="ignore"):
        thin = jnp.asarray(np.log(rng.choice([0, 1e-4, 0.02, 0.5, 3], (500, 3))), jnp.float32)
    gaussians = replace(random_gaussians(n=500, degree=0, spread=3.0), log_scales=thin)
    splats = project(gaussians, camera)
    found = planes(gaussians, camera, splats)
    assert all(np.isfinite(leaf).all() for leaf in found)
    drawn = np.asarray(splats.extents[:, 0] > 0)
    assert drawn.sum() > 100
    u, v, w = np.asarray(splats.sqrt_conics, np.float64)[drawn].T
    slopes, disparities = np.asarray(found.slopes)[drawn], np.asarray(found.disparities)[drawn]
    first = slopes[:, 0] / u
    second = (slopes[:, 1] - v * first) / w
    reach = np.sqrt(np.maximum(2 * np.log(np.asarray(splats.opacities)[drawn] * 255), 0))
    assert (disparities - reach * np.hypot(first, second) > 0.09 * disparities).all()


def test_normals_of_the_depth_of_a_plane_are_its_normal(camera):
    normals = normals_of(camera, depth_of_plane(camera))
    assert_allclose(normals, np.broadcast_to(NORMAL, normals.shape), atol=1e-9)


def test_normals_of_a_depth_with_holes_are_zero_beside_them_and_have_finite_gradients():
    camera = camera_at()
    depth = jnp.full((24, 32), 3.0).at[10, 7].set(0)
    normals = np.asarray(normals_of(camera, depth))
    missing = {(int(y), int(x)) for y, x in np.argwhere((normals == 0).all(axis=2))}
    assert missing == {(10, 7), (9, 7), (11, 7), (10, 6), (10, 8)}
    gradient = jax.grad(lambda depth: jnp.sum(normals_of(camera, depth) ** 3))(depth)
    assert np.isfinite(gradient).all()


def test_positions_are_seen_at_their_pixels(camera):
    points = positions_of(camera, depth_of_plane(camera))
    assert_allclose(points @ NORMAL, 0, atol=1e-9)


def test_a_panorama_has_its_surfaces_on_both_sides_of_the_seam():
    gaussians = plane_of_gaussians(np.array([0.0, 0.0, 1.0]), n=900, sigma=0.15)
    behind = replace(gaussians, means=gaussians.means + jnp.array([0.0, 0.0, -2.0])[None])
    turned = jnp.eye(4).at[0, 0].set(-1).at[2, 2].set(-1)  # half a turn: the seam becomes the middle
    names = ("surface_depth", "median_surface_depth", "normals")
    whole, middle = (render(behind, panorama(pose, 64, 32), outputs=names) for pose in (jnp.eye(4), turned))
    for name in names:
        there, here = (np.asarray(getattr(drawn, name)) for drawn in (whole, middle))
        assert there[16, 0].any()
        assert_array_equal(there[16, 0] > 0, there[16, -1] > 0)
        assert_allclose(np.roll(here, 32, axis=1), there, atol=2e-3)
