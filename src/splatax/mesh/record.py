"""The record of a triangle mesh, and the parts of it that are joined."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the world of its scene.

    Attributes:
        vertices: positions, world units.
        faces: three rows of `vertices` each, counterclockwise seen from outside.
        colors: sRGB of each vertex.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colors: UInt8[np.ndarray, "n 3"]

    @property
    def crosses(self) -> Float[np.ndarray, "m 3"]:
        """Vectors along the normals of the faces, twice as long as the area of each."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        return np.cross(b - a, c - a)

    @property
    def areas(self) -> Float[np.ndarray, " m"]:
        """Areas of the faces, world units squared."""
        return np.linalg.norm(self.crosses, axis=1) / 2

    @property
    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals of the vertices: means of those of the faces, weighted by area; zero without faces."""
        sums = np.zeros((len(self.vertices), 3))
        for corner in self.faces.T:
            for axis in range(3):
                sums[:, axis] += np.bincount(corner, self.crosses[:, axis], len(sums))
        return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)

    def with_faces(self, kept: np.ndarray) -> "Mesh":
        """Returns the mesh with some of its faces, and with the vertices of these.

        Args:
            kept: rows of `faces`, or a mask of them.
        """
        faces = self.faces[kept]
        used, renumbered = np.unique(faces, return_inverse=True)
        return Mesh(self.vertices[used], renumbered.reshape(-1, 3), self.colors[used])


def components_of(mesh: Mesh) -> Int[np.ndarray, " m"]:
    """Returns the number of the component that each face belongs to, from 0. Faces that share a vertex are
    in one component."""
    count = len(mesh.vertices)
    first, second, third = mesh.faces.T
    ends = (np.concatenate([first, second]), np.concatenate([second, third]))
    joined = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(count, count))
    return connected_components(joined, directed=False)[1][first]


def largest_components(mesh: Mesh, least: float) -> Mesh:
    """Returns the mesh without its small components.

    Args:
        mesh: the mesh.
        least: least area of a component that is kept, as a fraction of the area of the largest.
    """
    if not len(mesh.faces):
        return mesh
    component = components_of(mesh)
    areas = np.bincount(component, mesh.areas)
    return mesh.with_faces((areas >= least * areas.max())[component])
