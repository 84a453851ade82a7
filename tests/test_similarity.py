"""A scene and a camera that are transformed together give the same image."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.cameras import RollingShutter
from splatax.cameras.lenses import Orthographic
from splatax.math import harmonics
from splatax.transforms import Similarity, half_turn

PLACES = [
    Similarity.of(degrees=(20.0, -50.0, 130.0), scale=2.5, move=(3.0, -1.0, 0.5)),
    Similarity.of(degrees=(0.0, 0.0, 90.0)),
    Similarity.of(scale=0.1),
    Similarity(Rotation.random(rng=np.random.default_rng(0)).as_matrix(), np.array([-1.0, 2.0, 3.0]), 1.3),
]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("degree", range(5))
def test_the_picture_stays(place, degree):
    gaussians = random_gaussians(n=150, degree=degree)
    camera = camera_at((1.0, -2.0, -3.0), size=(48, 40), focal=40.0)
    before = sx.render(gaussians, camera)
    after = sx.render(place.transform(gaussians), place.transform_camera(camera))
    assert before.rgb.std() > 0.1
    assert_allclose(after.rgb, before.rgb, atol=2e-3)  # float32 through other coordinates
    assert_allclose(after.depth, place.scale * before.depth, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("kind", ["moving", "parallel"])
def test_the_picture_of_a_camera_with_lengths_of_its_own_stays(kind):
    place, gaussians = PLACES[0], random_gaussians(n=150, degree=1)
    camera = camera_at((1.0, -2.0, -3.0), size=(48, 40), focal=40.0)
    if kind == "moving":
        twist = jnp.array([0.1, 0.05, 0.0, 0.6, 0.0, 0.2])
        camera = replace(camera, motion=RollingShutter(twist))
    else:
        camera = replace(camera, lens=Orthographic(), fx=camera.fx / 4, fy=camera.fy / 4)
    before = sx.render(gaussians, camera)
    after = sx.render(place.transform(gaussians), place.transform_camera(camera))
    assert before.rgb.std() > 0.1
    assert_allclose(after.rgb, before.rgb, atol=2e-3)
    still = replace(place.transform_camera(camera), **{"motion": camera.motion, "fx": camera.fx})
    assert np.abs(sx.render(place.transform(gaussians), still).rgb - before.rgb).max() > 0.05


def test_a_camera_is_transformed_alike_under_jit_and_its_position_has_a_gradient():
    place, camera = PLACES[0], camera_at((1.0, -2.0, -3.0))
    traced = jax.jit(Similarity.transform_camera)(place.cast(jnp.float32), camera)
    known = place.transform_camera(camera)
    assert_allclose(traced.cam_from_world, known.cam_from_world, atol=2e-6)

    def position(move, pose):
        moved = Similarity(jnp.asarray(place.rotation, jnp.float32), move, jnp.float32(place.scale))
        return moved.transform_camera(replace(camera, cam_from_world=pose)).position

    move = jnp.asarray(place.translation, jnp.float32)
    slope = jax.jit(jax.jacobian(position))(move, camera.cam_from_world)
    assert_allclose(slope, np.eye(3), atol=1e-5)  # p' = s R p + t


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_turn_with_the_world(degree):
    rng = np.random.default_rng(degree)
    turn = Rotation.random(rng=rng).as_matrix()
    blocks = harmonics.rotation(turn, degree)
    sh = rng.normal(size=(harmonics.count(degree),))
    with jax.enable_x64(True):
        for direction in rng.normal(size=(20, 3)):
            direction /= np.linalg.norm(direction)
            here = harmonics.basis(jnp.asarray(direction), degree) @ sh
            there = harmonics.basis(jnp.asarray(turn @ direction), degree) @ (blocks @ sh)
            assert_allclose(there, here, atol=1e-12)


def test_rotations_of_harmonics_are_orthogonal_and_compose():
    a, b = (Rotation.random(rng=np.random.default_rng(i)).as_matrix() for i in range(2))
    of_a, of_b, of_both = (harmonics.rotation(m, 4) for m in (a, b, a @ b))
    assert_allclose(of_a @ of_a.T, np.eye(25), atol=1e-12)
    assert_allclose(of_a @ of_b, of_both, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_are_exact_and_undo_themselves(axis):
    gaussians = random_gaussians(degree=4)
    turned = half_turn(gaussians, axis)
    degrees = tuple(180.0 * (i == axis) for i in range(3))
    by_rotation = Similarity.of(degrees=degrees).transform(gaussians)
    assert_allclose(turned.means, by_rotation.means, atol=1e-6)
    assert_allclose(turned.covariances, by_rotation.covariances, atol=1e-6)
    assert_allclose(turned.sh, by_rotation.sh, atol=1e-6)
    for a, b in zip(jax.tree.leaves(half_turn(turned, axis)), jax.tree.leaves(gaussians), strict=True):
        assert_array_equal(a, b)


def test_one_place_after_another_is_both():
    gaussians = random_gaussians(n=20)
    first, second = PLACES[0], PLACES[3]
    step_by_step = second.transform(first.transform(gaussians))
    at_once = second.after(first).transform(gaussians)
    assert_allclose(at_once.means, step_by_step.means, atol=1e-5)
    assert_allclose(at_once.covariances, step_by_step.covariances, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("rotation", "scale", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), 1.0, "mirror"),
        (np.diag([1.0, 1.0, 2.0]), 1.0, "not a rotation"),
        (np.eye(3), 0.0, "scale > 0"),
        (np.eye(3), np.inf, "finite"),
    ],
)
def test_what_is_no_similarity_is_refused(rotation, scale, message):
    with pytest.raises(ValueError, match=message):
        Similarity(rotation, np.zeros(3), scale)


def test_the_inverse_is_computed_in_full_precision_on_devices_that_round_products():
    place = PLACES[0].cast(jnp.float32)
    program = str(jax.make_jaxpr(lambda place: jax.tree.leaves(place.inverse()))(place))
    assert program.count("dot_general") == program.count("(Precision.HIGHEST, Precision.HIGHEST)") == 1
