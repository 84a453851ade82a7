"""Skins: Gaussians that follow the joints of a skeleton, by linear blend skinning."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatax.gaussians import Gaussians
from splatax.math import ellipsoids, quaternions
from splatax.math.principal import principal_axes
from splatax.math.turning import turned
from splatax.pytrees import pytree
from splatax.scene.skeleton import Skeleton
from splatax.shapes import check_arrays


@pytree
@dataclass(frozen=True)
class Rig:
    """A skeleton, and the joints that each Gaussian follows.

    Attributes:
        skeleton: the joints.
        indices: joints of each Gaussian, k of them; repeated ones are allowed.
        weights: fraction of each; those of a Gaussian sum to 1.
    """

    skeleton: Skeleton
    indices: Int[Array, "n k"]
    weights: Float[Array, "n k"]


def skin(gaussians: Gaussians, rig: Rig, joints: Float[Array, "j 4 4"]) -> Gaussians:
    """Returns the Gaussians as the joints carry them. Differentiable in all arrays.

    Each Gaussian is transformed by the weighted mean of its joints' transforms,

        x' = A x + t,   [A t] = sum_k w_k [W_j B_j],   j = indices_k,

    with W the joints' transforms to the world and B the inverse binds. Its covariance becomes A S A^T, which
    includes the shear that blending causes. Its colour turns with it: the spherical harmonics are rotated
    by the weighted mean of the joints' unit quaternions, exactly. The derivative of the weights in
    space is not part of A.

    Args:
        gaussians: the scene in the pose in which it was bound.
        rig: the skeleton, and the weights of each Gaussian.
        joints: transforms of the joints to the world, such as `rig.skeleton.worlds(pose)`. Their linear parts
            are rotations times positive scales.

    Raises:
        ValueError: if the shapes or dtypes of the arrays do not fit together.
    """
    check_arrays(
        "Gaussians and Rig",
        {
            "means": (gaussians.means, "n 3"),
            "weights": (rig.weights, "n k"),
            "joints": (joints, "j 4 4"),
            "inverse_binds": (rig.skeleton.inverse_binds, "j 4 4"),
        },
    )
    if rig.indices.shape != rig.weights.shape or rig.indices.dtype.kind != "i":
        raise ValueError(
            f"Rig: indices are {rig.indices.dtype}{rig.indices.shape}, but must be whole numbers in the "
            f"shape of the weights, {rig.weights.shape}."
        )
    return _skin(gaussians, rig, joints)


@jax.jit
@jax.default_matmul_precision("highest")
def _skin(gaussians: Gaussians, rig: Rig, joints: Float[Array, "j 4 4"]) -> Gaussians:
    moves = joints @ rig.skeleton.inverse_binds
    blended = jnp.einsum("nk,nkij->nij", rig.weights, moves[rig.indices][:, :, :3])
    linear = blended[:, :, :3]
    means = jnp.einsum("nij,nj->ni", linear, gaussians.means) + blended[:, :, 3]
    factors = linear @ jax.vmap(ellipsoids.covariance_factor)(gaussians.quats, gaussians.scales)
    quats, scales = jax.vmap(principal_axes)(factors)
    positive = scales > 0
    log_scales = jnp.where(positive, jnp.log(jnp.where(positive, scales, 1)), -jnp.inf)
    sh = gaussians.sh
    if gaussians.sh_degree > 0:
        sh = jax.vmap(turned)(sh, jax.vmap(quaternions.to_rotation)(rotations(rig, moves)))
    return replace(gaussians, means=means, quats=quats, log_scales=log_scales, sh=sh)


def rotations(rig: Rig, moves: Float[Array, "j 4 4"]) -> Float[Array, "n 4"]:
    """Returns the rotation of each Gaussian: the weighted mean of its joints' unit quaternions.

    The quaternions q and -q are the same rotation. Each joint's is taken on the side of the joint with the
    largest weight.

    Args:
        rig: the weights of each Gaussian.
        moves: transforms of the joints from the bound pose.
    """
    linear = moves[:, :3, :3]
    lengths = jnp.sqrt(jnp.sum(linear * linear, axis=1, keepdims=True))
    turns = jax.vmap(quaternions.from_rotation)(linear / lengths)[rig.indices]
    first = jnp.take_along_axis(turns, jnp.argmax(rig.weights, axis=1)[:, None, None], axis=1)
    signs = jnp.where(jnp.sum(turns * first, axis=2, keepdims=True) < 0, -1, 1).astype(turns.dtype)
    blended = jnp.sum(rig.weights[:, :, None] * signs * turns, axis=1)
    return jax.vmap(quaternions.normalize)(blended)
