"""Small skeletons and rigs for tests."""

import jax.numpy as jnp
import numpy as np

from scenes import random_gaussians
from splatax.scene.skeleton import Pose, Skeleton
from splatax.scene.skin import Rig


def arm(joints=3) -> Skeleton:
    """A chain along x with bones of length 1, each turned a little against the one before."""
    rng = np.random.default_rng(5)
    quats = np.concatenate([np.ones((joints, 1)), 0.2 * rng.normal(size=(joints, 3))], axis=1)
    translations = np.array([[0.3, -0.2, 0.1]] + [[1.0, 0, 0]] * (joints - 1))
    rest = Pose(*(jnp.asarray(rows, jnp.float32) for rows in (translations, quats, np.ones((joints, 3)))))
    names = tuple(f"bone {i}" for i in range(joints))
    still = jnp.eye(4, dtype=jnp.float32)
    parents = tuple(range(-1, joints - 1))
    free = Skeleton(rest, jnp.tile(still, (joints, 1, 1)), still, names, parents)
    inverse = np.linalg.inv(np.asarray(free.worlds(rest), np.float64))
    return Skeleton(rest, jnp.asarray(inverse, jnp.float32), free.root, names, free.parents)


def bent(skeleton: Skeleton, angle=0.6) -> Pose:
    return skeleton.turned({name: jnp.array([0.2, angle, -0.3], jnp.float32) for name in skeleton.names})


def blended(n=20, joints=3, degree=1, **settings):
    """Gaussians that follow two joints each, with their rig."""
    rng = np.random.default_rng(3)
    gaussians = random_gaussians(n=n, degree=degree, **settings)
    weights = rng.dirichlet(np.ones(2), n)
    indices = np.stack([rng.permutation(joints)[:2] for _ in range(n)])
    return gaussians, Rig(arm(joints), jnp.asarray(indices, jnp.int32), jnp.asarray(weights, jnp.float32))
