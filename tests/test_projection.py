"""Projection, compared with linear algebra and finite differences, and its limits."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians
from splatax.cameras.lenses import Orthographic
from splatax.low_pass import AlongRays, Antialiasing, Dilation
from splatax.math import quaternions
from splatax.rendering import project, render

LOW_PASSES = [Dilation(), Antialiasing(), AlongRays()]


def one_gaussian(**fields):
    """A round red Gaussian of size 0.1 at the origin."""
    gaussians = random_gaussians(n=1, degree=0)
    defaults = {
        "means": jnp.zeros((1, 3)),
        "log_scales": jnp.full((1, 3), jnp.log(0.1)),
        "opacity_logits": jnp.full(1, 2.0),
        "sh": jnp.array([[[1.0, -1.0, -1.0]]]),
    }
    return replace(gaussians, **(defaults | fields))


def covariances_of(splats):
    """2 x 2 covariances from the roots of their inverses."""
    u, v, w = np.asarray(splats.sqrt_conics, np.float64).T
    roots = np.array([[u, v], [np.zeros_like(u), w]]).transpose(2, 0, 1)
    return np.linalg.inv(roots.transpose(0, 2, 1) @ roots)


def test_covariance_is_j_w_sigma_w_j_plus_the_low_pass(x64):
    camera = camera_at(position=(1.0, 0.5, -4.0), dtype=np.float64)
    gaussians = random_gaussians(spread=0.5, dtype=np.float64)
    splats = project(gaussians, camera)

    points = jax.vmap(camera.to_camera)(gaussians.means)
    jacobians = jax.vmap(jax.jacfwd(camera.to_pixel))(points) @ camera.rotation
    expected = np.asarray(jacobians @ gaussians.covariances @ jacobians.transpose(0, 2, 1)) + 0.3 * np.eye(2)
    assert_allclose(covariances_of(splats), expected, rtol=1e-9)
    assert_allclose(splats.means2d, jax.vmap(camera.to_pixel)(points), rtol=1e-12)
    assert_allclose(splats.depths, points[:, 2], rtol=1e-12)


def test_determinant_of_a_needle_keeps_its_digits():
    # 1000 by 0 pixels before the low-pass: a c - b^2 of the float32 covariance is off by 20 %.
    camera = camera_at(focal=1000.0, size=(400, 300))
    diagonal = jnp.array([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]], jnp.float32)
    needle = one_gaussian(quats=diagonal, log_scales=jnp.log(jnp.array([[4.0, 1e-6, 1e-6]])))
    splats = project(needle, camera)
    determinant = 1 / np.prod(np.asarray(splats.sqrt_conics, np.float64)[0, [0, 2]]) ** 2
    exact = np.linalg.det(covariances_of(project_in_double(needle, camera))[0])
    assert_allclose(determinant, exact, rtol=1e-5)


def project_in_double(gaussians, camera):
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), (gaussians, camera))
        return jax.tree.map(np.asarray, project(*double))


def test_extent_ends_where_alpha_falls_under_one_8_bit_level():
    camera = camera_at()
    splats = project(one_gaussian(), camera)
    alpha_at_edge = []
    for axis in range(2):
        # The lowest Mahalanobis distance on the edge of the box is where the ellipse touches it.
        covariance = covariances_of(splats)[0]
        distance = splats.extents[0, axis] ** 2 / covariance[axis, axis]
        alpha_at_edge.append(splats.opacities[0] * np.exp(-distance / 2))
    assert_allclose(alpha_at_edge, 1 / 255, rtol=1e-4)


@pytest.mark.parametrize("opacity", [0.0039, 0.0])
def test_too_transparent_to_draw_is_culled(opacity):
    logit = jnp.full(1, np.log(opacity / (1 - opacity)) if opacity else -jnp.inf, jnp.float32)
    assert_array_equal(project(one_gaussian(opacity_logits=logit), camera_at()).extents, 0)


@pytest.mark.parametrize("z", [-5.0, -4.0, -3.995])
def test_behind_or_nearer_than_the_near_plane_is_culled(z):
    assert_array_equal(project(one_gaussian(means=jnp.array([[0, 0, z]])), camera_at()).extents, 0)


def test_beside_the_image_is_culled_and_reaching_into_it_is_not():
    camera = camera_at(size=(32, 24), focal=30.0)
    beside = one_gaussian(means=jnp.array([[4.0, 0, 0]]))
    assert_array_equal(project(beside, camera).extents, 0)
    reaching = replace(beside, log_scales=jnp.log(jnp.full((1, 3), 1.0)))
    assert np.all(project(reaching, camera).extents > 0)


def test_antialiasing_keeps_the_light_of_a_splat_smaller_than_a_pixel():
    """The light of a splat is opacity times area: blur without fading adds light, fading keeps it."""
    near = camera_at(position=(0, 0, -4.0), focal=1e4, size=(4000, 3000))
    for distance in (400.0, 4000.0):
        far = camera_at(position=(0, 0, -distance), focal=1e4, size=(4000, 3000))
        light = []
        for camera in (near, far):
            splats = project(one_gaussian(), camera, low_pass=Antialiasing(floor=0.0))
            light.append(splats.opacities[0] * np.sqrt(np.linalg.det(covariances_of(splats)[0])))
        assert_allclose(light[1] / light[0], (4.0 / distance) ** 2, rtol=1e-3)


def test_colour_depends_on_the_direction_of_view():
    """Band 1 along z: brighter when seen along +z than along -z, by 2 x 0.4886 x coefficient."""
    sh = jnp.zeros((1, 4, 3)).at[0, 2].set(0.5)
    front = project(one_gaussian(sh=sh), camera_at(position=(0, 0, -4.0))).colors[0]
    back = project(one_gaussian(sh=sh), camera_at(position=(0, 0, 4.0))).colors[0]
    assert_allclose(front - back, 2 * 0.4886025119029199 * 0.5, rtol=1e-5)
    assert_allclose(front + back, 1.0, rtol=1e-5)


def test_a_scene_is_drawn_with_the_filter_that_it_was_trained_with():
    plain, camera = random_gaussians(n=30), camera_at()
    light = jax.jit(
        jax.value_and_grad(lambda g, low_pass=None: jnp.sum(render(g, camera, low_pass=low_pass).rgb)),
        static_argnames="low_pass",
    )
    value, gradient = light(plain, low_pass=Antialiasing())
    own_value, own_gradient = light(replace(plain, low_pass=Antialiasing()))
    assert_array_equal(value, own_value)
    assert_array_equal(gradient.means, own_gradient.means)
    assert float(value) != float(light(plain)[0])


def beside_the_picture():
    """A red Gaussian in the middle, and a green one from beside the picture over it: nearer by depth only."""
    both = [
        one_gaussian(log_scales=jnp.full((1, 3), jnp.log(0.3)), opacity_logits=jnp.full(1, 6.0)),
        one_gaussian(
            means=jnp.array([[3.0, 0.0, -1.0]]),
            log_scales=jnp.log(jnp.array([[3.0, 1.0, 0.01]])),
            opacity_logits=jnp.full(1, 6.0),
            quats=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
            sh=jnp.array([[[-1.0, 1.0, -1.0]]]),
        ),
    ]
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *both)


def test_a_gaussian_beside_the_picture_that_is_farther_is_drawn_behind_by_distance_and_in_front_by_depth():
    scene, camera = beside_the_picture(), camera_at()
    splats = project(replace(scene, order="distance"), camera)
    assert splats.depths[1] < splats.depths[0]
    assert_allclose(splats.sort_keys, np.linalg.norm(np.asarray(scene.means) - [0, 0, -4], axis=1), rtol=1e-6)
    depth, distance = (
        render(replace(scene, order=order), camera).rgb[12, 16] for order in ("depth", "distance")
    )
    assert depth[1] > 0.5 > depth[0]
    assert distance[0] > 0.5 > distance[1]


def test_the_order_by_distance_stays_when_the_camera_turns():
    scene = replace(random_gaussians(n=50), order="distance")
    ahead, aside = (project(scene, camera_at(target=target)) for target in ((0, 0, 0), (1.5, -1.0, 0.0)))
    assert_allclose(ahead.sort_keys, aside.sort_keys, rtol=2e-6)
    assert np.any(np.argsort(ahead.depths) != np.argsort(aside.depths))


def test_cameras_without_a_centre_draw_by_depth():
    scene = replace(random_gaussians(n=5), order="distance")
    assert project(scene, replace(camera_at(), lens=Orthographic())).sort_keys is None


def test_an_order_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"order of splats is 'far'\. Choose 'depth' or 'distance'"):
        render(replace(random_gaussians(n=3), order="far"), camera_at())


@pytest.mark.parametrize("place", [(jnp.nan, 0, 0), (jnp.inf, 0, 0), (1e30, -1e30, 1e30), (0, 0, -4.0)])
def test_keys_and_gradients_of_the_order_by_distance_are_finite(place):
    scene = replace(one_gaussian(means=jnp.array([place])), order="distance")
    assert np.isfinite(project(scene, camera_at()).sort_keys).all()
    gradient = jax.grad(lambda g, c: jnp.sum(render(g, c).rgb), (0, 1))(scene, camera_at())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_colour_below_zero_is_clamped_and_has_no_gradient():
    dark = one_gaussian(sh=jnp.full((1, 1, 3), -5.0))
    assert_array_equal(project(dark, camera_at()).colors, 0)
    gradient = jax.grad(lambda g: jnp.sum(project(g, camera_at()).colors))(dark)
    assert_array_equal(gradient.sh, 0)


@pytest.mark.slow
@pytest.mark.parametrize("low_pass", [Dilation(), Antialiasing()])
def test_gradients_of_scene_camera_and_background_match_finite_differences(low_pass, x64):
    """Through the whole renderer, in double precision, one random direction per argument."""
    gaussians = random_gaussians(n=12, spread=0.6, dtype=np.float64)
    camera = camera_at(size=(17, 13), focal=14.0, dtype=np.float64)
    background = jnp.array([0.3, 0.6, 0.1])
    rng = np.random.default_rng(0)
    weights = [jnp.asarray(rng.normal(size=shape)) for shape in ((13, 17, 3), (13, 17), (13, 17))]

    @jax.jit
    def objective(arguments):
        gaussians, camera, background = arguments
        drawn = render(gaussians, camera, background=background, low_pass=low_pass, backend="xla")
        return sum(
            jnp.sum(w * x) for w, x in zip(weights, (drawn.rgb, drawn.alpha, drawn.depth), strict=True)
        )

    arguments = (gaussians, camera, background)
    gradient = jax.grad(objective)(arguments)
    leaves, tree = jax.tree.flatten(arguments)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(arguments)[0]]
    step = 1e-6
    for i, name in enumerate(names):
        direction = jnp.asarray(rng.normal(size=leaves[i].shape))
        moved = [
            tree.unflatten([*leaves[:i], leaves[i] + s * step * direction, *leaves[i + 1 :]]) for s in (1, -1)
        ]
        finite = (objective(moved[0]) - objective(moved[1])) / (2 * step)
        assert_allclose(
            jnp.sum(jax.tree.leaves(gradient)[i] * direction), finite, rtol=2e-5, atol=1e-7, err_msg=name
        )


DEGENERATE = {
    "zero quaternion": {"quats": jnp.zeros((1, 4))},
    "in the camera plane": {"means": jnp.array([[0.5, 0.2, -4.0]])},
    "at the camera": {"means": jnp.array([[0.0, 0.0, -4.0]])},
    "zero scale": {"log_scales": jnp.full((1, 3), -jnp.inf)},
    "flat": {"log_scales": jnp.array([[-2.0, -2.0, -jnp.inf]])},
    "huge": {"log_scales": jnp.full((1, 3), 80.0)},
    "far away": {"means": jnp.array([[1e30, -1e30, 1e30]])},
    "beside the camera": {"means": jnp.array([[1e30, 0.0, -3.9]])},
    "opaque": {"opacity_logits": jnp.full(1, 200.0)},
    "empty slot": {"opacity_logits": jnp.full(1, -jnp.inf)},
}


@pytest.mark.slow
@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("low_pass", LOW_PASSES)
def test_image_and_gradients_are_finite_for_degenerate_gaussians(case, low_pass):
    value, gradient = light_and_gradient(one_gaussian(**DEGENERATE[case]), camera_at(), low_pass)
    for leaf in jax.tree.leaves((value, gradient)):
        assert np.all(np.isfinite(leaf))


@partial(jax.jit, static_argnames="low_pass")
def light_and_gradient(gaussians, camera, low_pass):
    """Of a picture: one program for all cases."""

    def light(gaussians, camera):
        drawn = render(gaussians, camera, low_pass=low_pass, backend="xla")
        return jnp.sum(drawn.rgb) + jnp.sum(drawn.depth)

    return jax.value_and_grad(light, argnums=(0, 1))(gaussians, camera)


def test_culled_gaussians_have_no_gradient():
    gaussians = random_gaussians(n=40, spread=6.0)
    camera = camera_at()
    culled = np.all(np.asarray(project(gaussians, camera).extents) == 0, axis=1)
    assert 5 < culled.sum() < 35
    gradient = jax.grad(lambda g: jnp.sum(render(g, camera, backend="xla").rgb))(gaussians)
    for leaf in jax.tree.leaves(gradient):
        assert_array_equal(np.asarray(leaf)[culled], 0)
        assert np.any(np.asarray(leaf)[~culled] != 0)


def test_rotation_of_world_and_camera_together_changes_no_shape():
    gaussians = random_gaussians(degree=0)
    turn = quaternions.to_rotation(jnp.array([0.9, 0.3, -0.2, 0.1]))
    factors = jax.vmap(quaternions.to_rotation)(gaussians.quats)
    camera = camera_at()
    turned_camera = replace(camera, cam_from_world=camera.cam_from_world @ jnp.eye(4).at[:3, :3].set(turn.T))
    turned = replace(gaussians, means=gaussians.means @ turn.T, quats=quats_of(turn @ factors))
    for name in ("means2d", "sqrt_conics", "depths"):
        assert_allclose(
            getattr(project(turned, turned_camera), name),
            getattr(project(gaussians, camera), name),
            rtol=2e-4,
            atol=2e-4,
        )


def quats_of(rotations):
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(np.asarray(rotations)).as_quat()
    return jnp.asarray(xyzw[:, [3, 0, 1, 2]], jnp.float32)
