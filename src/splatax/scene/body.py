"""Bodies: meshes with a skeleton and clips."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from splatax.scene.clips import Clip
from splatax.scene.skeleton import Skeleton

JOINTS = 4  # joints that a vertex may follow, as in one set of glTF's attributes


@dataclass(frozen=True)
class Surface:
    """Triangles whose corners follow joints.

    Attributes:
        vertices: in the pose in which the body was bound, world units.
        triangles: indices of their corners.
        indices: joints of each vertex.
        weights: fraction of each; those of a vertex sum to 1.
        colors: of each vertex, RGB in [0, 1], display-referred.
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    indices: Int[np.ndarray, "v k"]
    weights: Float[np.ndarray, "v k"]
    colors: Float[np.ndarray, "v 3"]

    def posed(self, moves: Float[np.ndarray, "j 4 4"]) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices as joints carry them.

        Args:
            moves: transforms of the joints from the bound pose, `skeleton.worlds(pose) @ inverse_binds`.
        """
        blended = np.einsum("vk,vkij->vij", self.weights, moves[self.indices][:, :, :3])
        return np.einsum("vij,vj->vi", blended[:, :, :3], self.vertices) + blended[:, :, 3]


@dataclass(frozen=True)
class Body:
    """A skeleton, the clips that move it, and the surface that it carries.

    Attributes:
        skeleton: the joints.
        clips: by name.
        surface: its triangles.
        notes: lines for people to read about parts of the file that are not used.
    """

    skeleton: Skeleton
    clips: dict[str, Clip]
    surface: Surface
    notes: tuple[str, ...] = ()


def strongest(
    indices: Int[np.ndarray, "v m"], weights: Float[np.ndarray, "v m"], most: int = JOINTS
) -> tuple[Int[np.ndarray, "v k"], Float[np.ndarray, "v k"]]:
    """Returns the joints with the largest weights, and the weights divided by their sum.

    A joint that occurs several times in a row counts once, with the sum of its weights.
    """
    weights = weights.copy()
    for first in range(weights.shape[1]):
        for later in range(first + 1, weights.shape[1]):
            again = np.where(indices[:, first] == indices[:, later], weights[:, later], 0)
            weights[:, first] += again
            weights[:, later] -= again
    order = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    indices, weights = (np.take_along_axis(rows, order, axis=1) for rows in (indices, weights))
    sums = weights.sum(axis=1, keepdims=True)
    weights = np.where(sums > 0, weights / np.where(sums > 0, sums, 1), np.eye(1, weights.shape[1]))
    return indices, weights
