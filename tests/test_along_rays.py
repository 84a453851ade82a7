"""Gaussians and discs drawn along rays, compared with their density and with known surfaces."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import along_rays
from splatax.cameras import RollingShutter
from splatax.cameras.geometry import ray
from splatax.cameras.lenses import Fisheye, Orthographic, opencv
from splatax.footprints import Unscented
from splatax.math import quaternions
from splatax.splats import MAX_ALPHA, MIN_ALPHA, joined
from splatax.stages import composite, project
from splatax.surfaces import pixel_centers

BLUR = 0.5  # variance, pixels^2
SIZE = (20, 15)
TWIST = jnp.array([0.02, -0.03, 0.05, 0.06, 0.02, -0.04])
KINDS = {
    "pinhole": {},
    "orthographic": {"lens": Orthographic()},
    "fisheye": {"lens": Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004]))},
    "opencv": {"lens": opencv(0.05, -0.02, 0.003, -0.002, 0.001)},
    "rolling shutter": {"motion": RollingShutter(TWIST)},
}
OTHERS = (  # left to `make slow`
    ("pinhole", False),
    ("fisheye", True),
    ("fisheye", False),
    ("rolling shutter", True),
    ("rolling shutter", False),
    ("orthographic", True),
    ("orthographic", False),
    ("opencv", True),
    ("opencv", False),
)


def camera_of(kind, position=(0.3, -0.2, -2.0), size=SIZE, focal=18.0):
    """A camera in double precision."""
    camera = replace(camera_at(position, size=size, focal=focal, dtype=np.float64), **KINDS[kind])
    if kind == "orthographic":
        camera = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2)
    return jax.tree.map(lambda leaf: leaf.astype(float), camera)


@pytest.fixture(params=["pinhole", "orthographic"])
def camera(request, x64):
    return camera_of(request.param)


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


def alpha_of_disc(gaussians, camera, i, mean2d, blur=BLUR):
    """Alpha of a flat Gaussian, from the point where each ray meets its plane."""
    origins, directions, pixels = rays_of(camera)
    first, second, normal = np.asarray(quaternions.to_rotation(gaussians.quats[i])).T
    mean, scale = np.asarray(gaussians.means[i]), np.asarray(gaussians.scales[i])
    t = ((mean - origins) @ normal) / (directions @ normal)
    met = origins + directions * t[..., None] - mean
    squared = ((met @ first) / scale[0]) ** 2 + ((met @ second) / scale[1]) ** 2
    squared = np.where((t > 0) | (not camera.lens.CENTRAL), squared, np.inf)
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
    for i in np.flatnonzero(np.asarray(splats.extents[:, 0]) > 0):
        expected = alpha_of_disc(gaussians, camera, i, np.asarray(splats.means2d[i]))
        assert_allclose(drawn_alone(splats, i), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "flat"),
    [
        ("pinhole", True),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in OTHERS),
    ],
)
def test_gradients_of_scene_and_camera_are_those_of_finite_differences(kind, flat, x64):
    """Of the camera: its pose, intrinsics, lens and motion."""
    gaussians, camera = scene(flat, n=6), camera_of(kind)
    shapes = jnp.ones((1, 3)).at[:, 2].set(0 if flat else 1)
    target = jnp.asarray(np.random.default_rng(0).normal(size=(*SIZE[::-1], 3)))

    def loss(means, quats, scales, logits, camera):
        moved = replace(
            gaussians,
            means=means,
            quats=quats,
            log_scales=jnp.where(shapes > 0, scales, -jnp.inf),
            opacity_logits=logits,
        )
        return jnp.sum(
            target * sx.render(moved, camera, low_pass=sx.AlongRays(BLUR), backend="reference").rgb
        )

    finite = jnp.where(jnp.isfinite(gaussians.log_scales), gaussians.log_scales, 0)
    fields = (gaussians.means, gaussians.quats, finite, gaussians.opacity_logits, camera)
    # A step that crosses the threshold of 1/255 at a pixel would show as an error: none does here.
    compiled = jax.jit(loss)
    arrays = lambda *numbers: compiled(*jax.tree.map(jnp.asarray, numbers))  # noqa: E731
    check_grads(arrays, fields, 1, ["rev"], eps=1e-7, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", ["pinhole", "fisheye", "rolling shutter"])
def test_the_thickness_of_ellipsoids_has_a_gradient(kind, x64):
    """The finite differences above would agree with the gradient also if nothing depended on it."""
    splats = project(scene(n=6), camera_of(kind), low_pass=sx.AlongRays(BLUR), backend="reference")

    def energy(slants):
        image, _ = composite(replace(splats, slants=slants), splats.colors, backend="reference")
        return jnp.sum(jnp.square(image))

    gradient = jax.jit(jax.grad(energy))(splats.slants)
    assert (np.abs(gradient[:, 2:5]).max(axis=0) > 1e-3).all()


def test_small_gaussians_look_as_their_ellipses():
    gaussians = random_gaussians(n=20, degree=0, scale=(0.015, 0.03))
    camera = camera_at((0.0, 0.0, -4.0), size=(200, 150), focal=500.0)
    exact, tangent = (
        sx.render(gaussians, camera, low_pass=low_pass, backend="reference", outputs=("alpha",)).alpha
        for low_pass in (sx.AlongRays(1e-6), sx.Dilation(0.0))
    )
    assert_allclose(exact, tangent, atol=0.01)


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


@pytest.mark.slow
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
@pytest.mark.parametrize(
    ("kind", "flat"),
    [
        ("fisheye", True),
        ("rolling shutter", True),
        ("opencv", True),
        ("fisheye", False),
        ("rolling shutter", False),
    ],
)
def test_other_lenses_and_moving_cameras_are_followed_to_first_order(kind, flat, x64):
    """Gaussians over which the lens and the time of the exposure change little."""
    camera = camera_of(kind, (0.3, -0.2, -3.0), size=(60, 45), focal=70.0)
    gaussians = random_gaussians(n=9, degree=0, spread=0.8, scale=(0.02, 0.1), dtype=np.float64)
    if flat:
        gaussians = replace(gaussians, log_scales=gaussians.log_scales.at[:, 2].set(-jnp.inf))
    splats = project(gaussians, camera, low_pass=sx.AlongRays(1e-3), backend="reference")
    shown = np.flatnonzero(np.asarray(splats.extents[:, 0]) > 0)
    alpha, drawn = alpha_of_disc if flat else alpha_along_rays, 0
    for i in shown:
        expected = alpha(gaussians, camera, i, np.asarray(splats.means2d[i]), 1e-3)
        assert_allclose(drawn_alone(splats, i), expected, atol=0.02)
        drawn += expected.max() > 0.2
    assert drawn > 4


def test_another_projection_is_refused():
    with pytest.raises(ValueError, match="Unscented"):
        sx.project(random_gaussians(n=2), camera_at(), low_pass=sx.AlongRays(), projection=Unscented())
