"""Skeletons: a tree of joints, and the poses that move it. Differentiable in the pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.errors import InputError, shown
from splatax.math import quaternions
from splatax.pytrees import pytree
from splatax.transforms import Similarity

Vector = Float[Array, "3"] | Float[np.ndarray, "3"] | Sequence[float]


@pytree
@dataclass(frozen=True)
class Pose:
    """The transform of each joint to the frame of its parent: scale, then rotate, then translate.

    Attributes:
        translations: in units of the parent's frame.
        quats: rotations (w, x, y, z), not necessarily unit.
        scales: factors along the joint's own axes.
    """

    translations: Float[Array, "j 3"]
    quats: Float[Array, "j 4"]
    scales: Float[Array, "j 3"]

    @property
    def matrices(self) -> Float[Array, "j 4 4"]:
        """Transforms from each joint's frame to its parent's."""
        return jax.vmap(_matrix)(self.translations, self.quats, self.scales)


def _matrix(
    translation: Float[Array, "3"], quat: Float[Array, "4"], scale: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    linear = quaternions.to_rotation(quat) * scale[None, :]
    top = jnp.concatenate([linear, translation[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], linear.dtype)])


@pytree
@dataclass(frozen=True)
class Skeleton:
    """A tree of joints. Parents come before their children.

    Attributes:
        rest: pose in which the file stores the joints.
        inverse_binds: transforms from the world, with the body in the pose in which it was bound, to the
            frame of each joint.
        root: transform from the frame of the joints without parents to the world.
        names: unique names of the joints. Static under `jit`.
        parents: index of each joint's parent; -1 without one. Static under `jit`.
    """

    rest: Pose
    inverse_binds: Float[Array, "j 4 4"]
    root: Float[Array, "4 4"]
    names: tuple[str, ...] = field(metadata={"static": True})
    parents: tuple[int, ...] = field(metadata={"static": True})

    def __len__(self) -> int:
        return len(self.names)

    @jax.jit
    @jax.default_matmul_precision("highest")
    def worlds(self, pose: Pose) -> Float[Array, "j 4 4"]:
        """Returns the transform of each joint to the world in a pose: forward kinematics."""
        local, worlds = pose.matrices, jnp.zeros_like(pose.matrices)
        for level in _levels(self.parents):
            above = np.array([self.parents[joint] for joint in level])
            places = self.root[None] if above[0] < 0 else worlds[above]
            worlds = worlds.at[np.array(level)].set(places @ local[np.array(level)])
        return worlds

    def index(self, name: str) -> int:
        """Returns the index of a joint.

        Raises:
            InputError: if there is no joint of this name.
        """
        if name not in self.names:
            listed = ", ".join(self.names)
            raise InputError(f"no joint is called {shown(name)}. The joints are {shown(listed, 300)}.")
        return self.names.index(name)

    def moved(self, place: Similarity) -> "Skeleton":
        """Returns the skeleton in a world that a similarity transforms, with the bound pose."""
        binds = np.asarray(self.inverse_binds, np.float64) @ place.inverse().matrix
        root = place.matrix @ np.asarray(self.root, np.float64)
        return replace(
            self, inverse_binds=jnp.asarray(binds, jnp.float32), root=jnp.asarray(root, jnp.float32)
        )

    def turned(self, rotations: Mapping[str, Vector], pose: Pose | None = None) -> Pose:
        """Returns a pose with some joints turned about their own axes.

        Args:
            rotations: rotation vectors by the name of the joint, radians.
            pose: the pose to change; by default `rest`.

        Raises:
            InputError: if there is no joint of a name.
        """
        vectors = jnp.zeros((len(self), 3), jnp.float32)
        for name, vector in rotations.items():
            vectors = vectors.at[self.index(name)].set(jnp.asarray(vector, jnp.float32))
        return spun(pose or self.rest, vectors)


def spun(pose: Pose, vectors: Float[Array, "j 3"]) -> Pose:
    """Returns a pose in which each joint is turned about its own axes by a rotation vector, radians."""
    return replace(pose, quats=_spun(pose.quats, vectors))


@jax.jit
def _spun(quats: Float[Array, "j 4"], vectors: Float[Array, "j 3"]) -> Float[Array, "j 4"]:
    return jax.vmap(quaternions.multiply)(quats, jax.vmap(_exponential)(vectors))


def _exponential(vector: Float[Array, "3"]) -> Float[Array, "4"]:
    """Returns the unit quaternion of a rotation vector, with a derivative at zero."""
    squared = vector @ vector
    small = squared < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1, squared))
    sinc = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle)
    cosine = jnp.where(small, 1 - squared / 8, jnp.cos(angle / 2))
    return jnp.concatenate([cosine[None], sinc * vector])


def _levels(parents: tuple[int, ...]) -> list[list[int]]:
    """Returns the joints by their depth in the tree."""
    depths: list[int] = []
    for parent in parents:
        depths.append(0 if parent < 0 else depths[parent] + 1)
    return [[joint for joint, depth in enumerate(depths) if depth == d] for d in range(max(depths) + 1)]
