"""Skinning, compared with closed forms, finite differences and rigid transforms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatax as sx
from scene.skeletons import arm, bent, blended
from scenes import camera_at, random_gaussians
from splatax.math import harmonics
from splatax.math.principal import principal_axes
from splatax.math.quaternions import to_rotation
from splatax.math.turning import turned
from splatax.scene.skin import Rig, skin
from splatax.transforms import Similarity


def on_one_joint(gaussians, skeleton, joint):
    n = len(gaussians)
    return Rig(skeleton, jnp.full((n, 1), joint, jnp.int32), jnp.ones((n, 1)))


def test_gaussians_on_one_joint_move_as_by_one_similarity():
    gaussians, skeleton = random_gaussians(n=30, degree=3), arm()
    joints = skeleton.worlds(bent(skeleton))
    moved = skin(gaussians, on_one_joint(gaussians, skeleton, 2), joints)
    move = np.asarray(joints, np.float64)[2] @ np.asarray(skeleton.inverse_binds, np.float64)[2]
    rigid = Similarity(move[:3, :3], move[:3, 3]).transform(gaussians)
    np.testing.assert_allclose(moved.means, rigid.means, atol=2e-6)
    np.testing.assert_allclose(moved.covariances, rigid.covariances, atol=1e-6)
    np.testing.assert_allclose(moved.sh, rigid.sh, atol=3e-6)
    np.testing.assert_array_equal(moved.opacity_logits, gaussians.opacity_logits)
    camera = camera_at()
    np.testing.assert_allclose(sx.render(moved, camera).rgb, sx.render(rigid, camera).rgb, atol=2e-5)


def test_the_bound_pose_leaves_the_scene_as_it_is():
    gaussians, rig = blended()
    still = skin(gaussians, rig, rig.skeleton.worlds(rig.skeleton.rest))
    np.testing.assert_allclose(still.means, gaussians.means, atol=2e-6)
    np.testing.assert_allclose(still.covariances, gaussians.covariances, atol=1e-6)


def test_a_joint_that_scales_makes_gaussians_larger():
    gaussians, skeleton = random_gaussians(n=8, degree=0), arm()
    pose = replace(skeleton.rest, scales=skeleton.rest.scales.at[0].set(3.0))
    moved = skin(gaussians, on_one_joint(gaussians, skeleton, 1), skeleton.worlds(pose))
    np.testing.assert_allclose(moved.log_scales, gaussians.log_scales + np.log(3), atol=1e-5)


def test_the_covariance_of_a_blend_is_that_of_the_blended_transform():
    """A S A^T, shear included, computed in double precision."""
    gaussians, rig = blended(n=40)
    joints = rig.skeleton.worlds(bent(rig.skeleton, 1.2))
    moved = skin(gaussians, rig, joints)
    moves = np.asarray(joints, np.float64) @ np.asarray(rig.skeleton.inverse_binds, np.float64)
    blend = np.einsum("nk,nkij->nij", rig.weights, moves[rig.indices])[:, :3, :3]
    expected = blend @ np.asarray(gaussians.covariances, np.float64) @ blend.transpose(0, 2, 1)
    shear = np.abs(blend @ blend.transpose(0, 2, 1) - np.eye(3)).max()
    assert shear > 0.1  # the blends are far from rotations
    np.testing.assert_allclose(moved.covariances, expected, rtol=1e-4, atol=1e-7)


def test_opposite_quaternions_of_one_rotation_do_not_cancel():
    gaussians, skeleton = random_gaussians(n=1, degree=1), arm(2)
    half_turn = skeleton.turned({"bone 1": jnp.array([0.0, 0.0, 3.1])})
    beyond = skeleton.turned({"bone 1": jnp.array([0.0, 0.0, 3.2])})
    rig = Rig(skeleton, jnp.array([[0, 1]]), jnp.array([[0.49, 0.51]]))
    for pose in (half_turn, beyond):
        moved = skin(gaussians, rig, skeleton.worlds(pose))
        length = np.linalg.norm(moved.sh[:, 1:])
        np.testing.assert_allclose(length, np.linalg.norm(gaussians.sh[:, 1:]), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["pose", "weights", "gaussians"])
def test_derivatives_agree_with_finite_differences(what, x64):
    gaussians, rig = blended(n=6, degree=1)
    gaussians, rig, pose = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf,
        (gaussians, rig, bent(rig.skeleton)),
    )
    rng = np.random.default_rng(0)
    wanted = [jnp.asarray(rng.normal(size=s)) for s in ((6, 3), (6, 3, 3), (6, 4, 3))]

    def loss(gaussians, rig, pose):
        moved = skin(gaussians, rig, rig.skeleton.worlds(pose))
        parts = zip(wanted, (moved.means, moved.covariances, moved.sh), strict=True)
        return sum(jnp.sum(w * part) for w, part in parts)

    def along(t):
        if what == "pose":
            return loss(gaussians, rig, replace(pose, quats=pose.quats + t * direction))
        if what == "weights":
            return loss(gaussians, replace(rig, weights=rig.weights + t * direction), pose)
        return loss(
            replace(
                gaussians, quats=gaussians.quats + t * direction, log_scales=gaussians.log_scales + t * other
            ),
            rig,
            pose,
        )

    direction = jnp.asarray(rng.normal(size={"pose": (3, 4), "weights": (6, 2), "gaussians": (6, 4)}[what]))
    other = jnp.asarray(rng.normal(size=(6, 3)))
    step = 1e-5
    moved = jax.jit(along)
    numeric = (moved(step) - moved(-step)) / (2 * step)
    # The derivative of axes fades where scales are alike; those here differ by some per cent at least.
    np.testing.assert_allclose(jax.jit(jax.grad(along))(0.0), numeric, rtol=2e-3)


def test_one_program_draws_all_poses_under_jit_and_vmap():
    gaussians, rig = blended(n=12)
    poses = [bent(rig.skeleton, angle) for angle in (0.1, 0.4)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *poses)
    together = jax.jit(jax.vmap(lambda pose: skin(gaussians, rig, rig.skeleton.worlds(pose))))(stacked)
    for i, pose in enumerate(poses):
        alone = skin(gaussians, rig, rig.skeleton.worlds(pose))
        np.testing.assert_allclose(together.means[i], alone.means, atol=1e-6)
        np.testing.assert_allclose(together.sh[i], alone.sh, atol=1e-5)


def test_weights_of_another_number_of_gaussians_are_refused():
    _, rig = blended(n=6)
    with pytest.raises(ValueError, match="weights"):
        skin(random_gaussians(n=7, degree=1), rig, rig.skeleton.worlds(rig.skeleton.rest))


def test_harmonics_turn_exactly():
    rng = np.random.default_rng(2)
    rotation = Rotation.random(random_state=4).as_matrix()
    for degree in range(5):
        sh = rng.normal(size=(harmonics.count(degree), 3))
        expected = harmonics.rotation(rotation, degree) @ sh
        found = turned(jnp.asarray(sh, jnp.float32), jnp.asarray(rotation, jnp.float32))
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("scales", [(1, 2, 3), (1, 1, 1), (1, 1, 2), (0, 1, 2), (1e-4, 1, 1)])
def test_principal_axes_give_the_covariance_back(scales):
    rng = np.random.default_rng(6)
    for mirror in (1, -1):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        factor = q @ np.diag(scales) @ np.linalg.qr(rng.normal(size=(3, 3)))[0] * mirror
        quat, found = principal_axes(jnp.asarray(factor, jnp.float32))
        axes = np.asarray(to_rotation(quat)) * np.asarray(found)
        np.testing.assert_allclose(axes @ axes.T, factor @ factor.T, atol=3e-6)


def test_orthogonal_columns_keep_their_order():
    rotation = Rotation.random(random_state=1).as_matrix()
    quat, scales = principal_axes(jnp.asarray(rotation * [3.0, 1.0, 2.0], jnp.float32))
    np.testing.assert_allclose(scales, [3, 1, 2], rtol=1e-6)
    np.testing.assert_allclose(to_rotation(quat), rotation, atol=1e-6)


def test_indices_that_are_no_joints_of_each_gaussian_are_refused():
    gaussians, rig = blended(n=4)
    joints = rig.skeleton.worlds(rig.skeleton.rest)
    for wrong in (rig.indices[:-1], rig.indices.astype(jnp.float32)):
        with pytest.raises(ValueError, match="indices"):
            skin(gaussians, replace(rig, indices=wrong), joints)
