"""Gaussians and discs drawn along rays, compared with their density and with known surfaces."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, plane_of_gaussians, random_gaussians
from splatax import along_rays
from splatax.cameras import RollingShutter
from splatax.cameras.geometry import ray
from splatax.cameras.lenses import Fisheye, Orthographic
from splatax.footprints import Unscented
from splatax.math import quaternions
from splatax.splats import MAX_ALPHA, MIN_ALPHA, joined
from splatax.stages import composite, project
from splatax.surfaces import pixel_centers

NORMAL = np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])
BLUR = 0.5  # variance, pixels^2
SIZE = (20, 15)


@pytest.fixture(params=["pinhole", "orthographic"])
def camera(request, x64):
    camera = camera_at((0.3, -0.2, -2.0), size=SIZE, focal=18.0, dtype=np.float64)
    if request.param == "pinhole":
        return camera
    return replace(camera, lens=Orthographic(), fx=camera.fx / 2, fy=camera.fy / 2)


def scene(flat=False, n=24):
    """Gaussians of all shapes: some behind the camera, some that surround it."""
    gaussians = random_gaussians(n=n, degree=0, spread=1.6, scale=(0.01, 0.7), dtype=np.float64)
    if flat:
        gaussians = replace(gaussians, log_scales=gaussians.log_scales.at[:, 2].set(-jnp.inf))
    return gaussians


def rays_of(camera):
    """Origins and directions of the rays of all pixels in the world, and the pixels, NumPy."""
    pixels = pixel_centers(camera.width, camera.height, camera.fx.dtype)
    origins, directions = jax.jit(jax.vmap(jax.vmap(lambda pixel: ray(camera, pixel))))(pixels)
    return np.asarray(origins), np.asarray(directions), np.asarray(pixels)


def alpha_of(opacity, squared, pixels, mean2d, blur=BLUR):
    """Alpha of a splat, from its squared distances along the rays."""
    round_ = np.sum((pixels - mean2d) ** 2, axis=-1) / blur
    alpha = np.minimum(MAX_ALPHA, opacity * np.exp(-np.minimum(squared, round_) / 2))
    return np.where(alpha >= MIN_ALPHA, alpha, 0)


def alpha_along_rays(gaussians, camera, i, mean2d, blur=BLUR):
    """Alpha of a Gaussian, from its density along each ray by plain linear algebra."""
    origins, directions, pixels = rays_of(camera)
    precision = np.linalg.inv(np.asarray(gaussians.covariances[i]))
    offset = origins - np.asarray(gaussians.means[i])
    a = np.einsum("hwi,ij,hwj->hw", directions, precision, directions)
    b = np.einsum("hwi,ij,hwj->hw", directions, precision, offset)
    c = np.einsum("hwi,ij,hwj->hw", offset, precision, offset)
    squared = np.where((b < 0) | (not camera.lens.CENTRAL), c - b * b / a, np.inf)
    return alpha_of(float(gaussians.opacities[i]), squared, pixels, mean2d, blur)


def drawn_alone(splats, i):
    one = jax.tree.map(lambda leaf: leaf[i : i + 1], splats)
    return composite(one, one.colors, backend="reference")[1]


@pytest.mark.slow
def test_alpha_is_that_of_the_densest_point_in_front_of_the_camera(camera):
    gaussians = scene()
    splats = project(gaussians, camera, low_pass=sx.AlongRays(BLUR), backend="reference")
    depths = np.asarray(gaussians.means) @ np.asarray(camera.rotation[2]) + float(camera.translation[2])
    drawn = 0
    for i in range(len(gaussians)):
        if depths[i] < 0.01:
            assert (np.asarray(splats.extents[i]) == 0).all()
            continue
        expected = alpha_along_rays(gaussians, camera, i, np.asarray(splats.means2d[i]))
        drawn += expected.any()
        assert_allclose(drawn_alone(splats, i), expected, atol=1e-9)
    assert drawn > 8


def test_alpha_of_a_disc_is_that_of_the_point_where_the_ray_meets_it(camera):
    gaussians = scene(flat=True)
    splats = project(gaussians, camera, low_pass=sx.AlongRays(BLUR), backend="reference")
    assert_allclose(splats.slants[:, 2:5], 0, atol=1e-12)
    origins, directions, pixels = rays_of(camera)
    axes = np.asarray(jax.vmap(quaternions.to_rotation)(gaussians.quats))
    means = np.asarray(gaussians.means)
    for i in np.flatnonzero(np.asarray(splats.extents[:, 0]) > 0):
        first, second, normal = axes[i].T
        t = ((means[i] - origins) @ normal) / (directions @ normal)
        met = origins + directions * t[..., None] - means[i]
        scale = np.asarray(gaussians.scales[i])
        squared = ((met @ first) / scale[0]) ** 2 + ((met @ second) / scale[1]) ** 2
        squared = np.where((t > 0) | (not camera.lens.CENTRAL), squared, np.inf)
        expected = alpha_of(float(gaussians.opacities[i]), squared, pixels, np.asarray(splats.means2d[i]))
        assert_allclose(drawn_alone(splats, i), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("camera", "flat"), [("pinhole", True), ("orthographic", False)], indirect=["camera"]
)
def test_gradients_of_scene_and_camera_are_those_of_finite_differences(camera, flat):
    gaussians = scene(flat, n=6)
    shapes = jnp.ones((1, 3)).at[:, 2].set(0 if flat else 1)
    target = jnp.asarray(np.random.default_rng(0).normal(size=(*SIZE[::-1], 3)))

    def loss(means, quats, scales, logits, pose, fx):
        moved = replace(
            gaussians,
            means=means,
            quats=quats,
            log_scales=jnp.where(shapes > 0, scales, -jnp.inf),
            opacity_logits=logits,
        )
        view = replace(camera, cam_from_world=pose, fx=fx)
        return jnp.sum(target * sx.render(moved, view, low_pass=sx.AlongRays(BLUR), backend="reference").rgb)

    finite = jnp.where(jnp.isfinite(gaussians.log_scales), gaussians.log_scales, 0)
    fields = (gaussians.means, gaussians.quats, finite, gaussians.opacity_logits)
    # A step that crosses the threshold of 1/255 at a pixel would show as an error: none does here.
    compiled = jax.jit(loss)
    arrays = lambda *numbers: compiled(*map(jnp.asarray, numbers))  # noqa: E731
    check_grads(
        arrays, (*fields, camera.cam_from_world, camera.fx), 1, ["rev"], eps=1e-7, atol=1e-4, rtol=1e-4
    )


def test_small_gaussians_look_as_their_ellipses():
    gaussians = random_gaussians(n=20, degree=0, scale=(0.015, 0.03))
    camera = camera_at((0.0, 0.0, -4.0), size=(200, 150), focal=500.0)
    exact, tangent = (
        sx.render(gaussians, camera, low_pass=low_pass, backend="reference", outputs=("alpha",)).alpha
        for low_pass in (sx.AlongRays(1e-6), sx.Dilation(0.0))
    )
    assert_allclose(exact, tangent, atol=0.01)


def test_a_plane_of_discs_has_its_exact_depth_and_normal():
    camera = camera_at((0.4, -0.3, -4.0), size=(32, 24), focal=40.0)
    discs = plane_of_gaussians(NORMAL, n=900, flat=1e-12)
    outputs = ("surface_depth", "median_surface_depth", "normals", "alpha")
    drawn = sx.render(discs, camera, low_pass=sx.AlongRays(), outputs=outputs, backend="xla")

    def depth(pixel):
        origin, direction = ray(camera, pixel)
        point = origin - direction * (NORMAL @ origin) / (NORMAL @ direction)
        return camera.lens.depth(camera.to_camera(point))

    expected = np.asarray(jax.vmap(jax.vmap(depth))(pixel_centers(32, 24, jnp.dtype("float32"))))
    covered = np.asarray(drawn.alpha) > 0.5
    assert covered.sum() > 200
    assert_allclose(drawn.surface_depth[covered], expected[covered], rtol=1e-5)
    assert_allclose(drawn.median_surface_depth[covered], expected[covered], rtol=1e-5)
    assert_allclose(drawn.normals[covered], np.broadcast_to(NORMAL, (covered.sum(), 3)), atol=1e-6)


def test_nothing_is_drawn_outside_of_the_box_of_a_splat():
    gaussians, camera = scene(), camera_at((0.3, -0.2, -2.0), size=(60, 45), focal=54.0)
    gaussians = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), gaussians)
    splats = project(gaussians, camera, low_pass=sx.AlongRays(), backend="reference")
    pixels = pixel_centers(60, 45, jnp.dtype("float32")).reshape(-1, 2)
    for i in np.flatnonzero(np.asarray(splats.extents[:, 0]) > 0):
        offsets = pixels - splats.means2d[i][None]
        rows = (
            jnp.broadcast_to(row[i], (len(pixels), row.shape[1]))
            for row in (splats.sqrt_conics, splats.slants)
        )
        alpha = splats.opacities[i] * np.exp(-0.5 * along_rays.squared_distances(offsets, *rows))
        outside = (np.abs(offsets) > splats.extents[i][None]).any(axis=1)
        assert (np.asarray(alpha)[outside] < MIN_ALPHA).all()


def test_ellipses_in_one_view_with_slanted_splats_are_drawn_as_before():
    camera = camera_at()
    ellipses = project(random_gaussians(n=30), camera, backend="reference")
    discs = project(random_gaussians(seed=1, n=30), camera, low_pass=sx.AlongRays(), backend="reference")
    hidden = replace(discs, opacities=0 * discs.opacities)
    image, _ = composite(joined([ellipses, hidden]), joined([ellipses, hidden]).colors, backend="reference")
    assert_allclose(image, composite(ellipses, ellipses.colors, backend="reference")[0], atol=1e-6)


def test_discs_seen_edge_on_are_drawn_as_blurs_and_have_finite_gradients():
    camera = camera_at((0.0, 0.0, -4.0), size=(32, 24))
    edge_on = replace(
        random_gaussians(n=2, degree=0),
        means=jnp.zeros((2, 3)),
        quats=jnp.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0 + 1e-6, 0.0, 0.0]]),  # normals along y
        log_scales=jnp.array([[-1.0, -1.0, -jnp.inf], [-jnp.inf, -jnp.inf, -jnp.inf]]),
        opacity_logits=jnp.full(2, 2.0),
    )

    def drawn(scene):
        return jnp.sum(
            sx.render(scene, camera, low_pass=sx.AlongRays(), backend="xla", outputs=("alpha",)).alpha
        )

    value, gradient = jax.value_and_grad(drawn)(edge_on)
    assert 1 < value < 8  # a blur of variance 1/2 has the area pi
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_other_lenses_and_moving_cameras_are_followed_to_first_order(x64):
    camera = camera_at((0.3, -0.2, -3.0), size=(120, 90), focal=140.0, dtype=np.float64)
    twist = jnp.array([0.02, -0.03, 0.05, 0.06, 0.02, -0.04])
    gaussians = replace(scene(n=5), log_scales=scene(n=5).log_scales - 2.0)
    for change in (
        {"lens": Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004]))},
        {"motion": RollingShutter(twist)},
    ):
        seen = jax.tree.map(lambda leaf: leaf.astype(float), replace(camera, **change))
        splats = project(gaussians, seen, low_pass=sx.AlongRays(1e-3), backend="reference")
        for i in np.flatnonzero(np.asarray(splats.extents[:, 0]) > 0):
            expected = alpha_along_rays(gaussians, seen, i, np.asarray(splats.means2d[i]), 1e-3)
            assert_allclose(drawn_alone(splats, i), expected, atol=0.02)


def test_another_projection_is_refused():
    with pytest.raises(ValueError, match="Unscented"):
        sx.project(random_gaussians(n=2), camera_at(), low_pass=sx.AlongRays(), projection=Unscented())
