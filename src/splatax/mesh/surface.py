"""Extraction of the surface of a volume: marching cubes over chunks of blocks, joined without seams."""

import numpy as np
from jaxtyping import Bool, Float, Int

from splatax.errors import InputError
from splatax.mesh.needed import needed
from splatax.mesh.record import Mesh
from splatax.mesh.views import Watch, unwatched
from splatax.mesh.volume import SIDE, Volume

CHUNK = 8  # blocks of a chunk's edge
STEPS = 1 << 18  # of a voxel, to which vertices on borders of chunks are rounded before they are joined
GREY = 128  # colour before the views have given one


def surface_of(volume: Volume, least_views: int = 1, watch: Watch = unwatched) -> Mesh:
    """Returns the surface where the distances are zero, as a mesh without colours.

    It ends where nothing was seen: all corners of a cell that it passes through were seen.

    Args:
        volume: the distances.
        least_views: number of views that must have seen a surface near the corners behind it.
        watch: shows progress over the chunks.

    Raises:
        InputError: if there is no surface.
        MissingPackageError: if scikit-image is not installed.
    """
    places: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    count = 0
    # A cell on the border between chunks is that of the lower one, which may have no block.
    below = volume.coordinates[:, None] - np.array(list(np.ndindex(2, 2, 2)))
    chunks = np.unique(below.reshape(-1, 3) // CHUNK, axis=0)
    for chunk in watch(list(chunks), "extracting the surface"):
        found = triangles_of(*dense(volume, chunk, least_views))
        if found is None:
            continue
        vertices, triangles = found
        steps = np.round(vertices.astype(np.float64) * STEPS).astype(np.int64)
        places.append(steps + chunk * (CHUNK * SIDE * STEPS))
        faces.append(triangles + count)
        count += len(vertices)
    if not places:
        raise InputError("The views have no surface in common. Use larger voxels.", options=("voxel",))
    unique, which = np.unique(np.concatenate(places), axis=0, return_inverse=True)
    joined = which.reshape(-1)[np.concatenate(faces)]
    first, second, third = joined.T
    flat = (first == second) | (second == third) | (third == first)
    colors = np.full((len(unique), 3), GREY, np.uint8)
    return Mesh(unique * (volume.voxel / STEPS), joined[~flat], colors)


def triangles_of(
    distances: Float[np.ndarray, "x y z"],
    seen: Bool[np.ndarray, "x y z"],
    supported: Bool[np.ndarray, "x y z"],
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]] | None:
    """Returns vertices, in voxels, and faces of the surface of a dense grid; None if there is none.

    Args:
        distances: positive in front of the surface.
        seen: whether the distance at a voxel is known.
        supported: whether enough views saw a surface near a voxel.
    """
    marching_cubes = needed().marching_cubes
    inside = distances < 0
    cells = np.all(corners_of(seen & (supported | ~inside)), axis=0)
    crossed = np.any(corners_of(inside), axis=0) & ~np.all(corners_of(inside), axis=0)
    if not np.any(cells & crossed):
        return None
    mask = np.zeros_like(seen)
    mask[1:, 1:, 1:] = cells  # the package looks at the highest corner of each cell
    vertices, faces, _, _ = marching_cubes(distances, 0.0, mask=mask, gradient_direction="descent")
    return vertices, faces


def corners_of(grid: np.ndarray) -> list[np.ndarray]:
    """Returns the values at the eight corners of each cell of a dense grid."""
    return [grid[tuple(slice(c, c - 1 or None) for c in corner)] for corner in np.ndindex(2, 2, 2)]


def dense(
    volume: Volume, chunk: Int[np.ndarray, "3"], least_views: int
) -> tuple[Float[np.ndarray, "s s s"], Bool[np.ndarray, "s s s"], Bool[np.ndarray, "s s s"]]:
    """Returns the distances of a chunk with one more layer of voxels, which of them were seen, and near which
    enough views saw a surface."""
    across = CHUNK + 1
    blocks = chunk * CHUNK + np.stack(np.meshgrid(*[np.arange(across)] * 3, indexing="ij"), -1).reshape(-1, 3)
    rows = volume.rows_of(blocks)
    shape = (across, across, across, SIDE, SIDE, SIDE)

    def grid(values: np.ndarray, missing: float | int) -> np.ndarray:
        chosen = np.full((len(rows), values.shape[1]), missing, values.dtype)
        chosen[rows >= 0] = values[rows[rows >= 0]]
        side = CHUNK * SIDE + 1
        spread = chosen.reshape(shape).transpose(0, 3, 1, 4, 2, 5).reshape([across * SIDE] * 3)
        return np.ascontiguousarray(spread[:side, :side, :side])

    seen, supported = grid(volume.weights, 0) > 0, grid(volume.views, 0) >= least_views
    return grid(volume.distances, 1.0), seen, supported
