"""Truncated signed distances in blocks of voxels, which exist only where surfaces were seen.

Voxel (i, j, k) of the world is at `voxel` times (i, j, k). A block holds 8 x 8 x 8 of them. Memory grows with
the area of the surfaces and not with the volume around them: a voxel takes 10 bytes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt16

from splatax.errors import InputError

SIDE = 8  # voxels of a block's edge
VOXELS = SIDE**3
BYTES = 10 * VOXELS  # of a block
TRUNCATION = SIDE / 2  # voxels from a surface at which distances end: half a block, see `blocks_around`
BITS = 21  # of each coordinate in a key
FARTHEST = 1 << (BITS - 1)  # blocks from the origin


@dataclass(frozen=True)
class Volume:
    """Distances from the surface, averaged over views. `fusion.integrate` changes the arrays in place.

    Attributes:
        voxel: width of a voxel, world units.
        keys: of the blocks, sorted; see `keys_of`.
        distances: distance of each voxel in front of the surface, divided by the truncation, in [-1, 1].
        weights: sums of the weights of the views that saw each voxel; 0 where none did.
        views: numbers of views that saw a surface within the truncation of each voxel.
    """

    voxel: float
    keys: Int[np.ndarray, " n"]
    distances: Float[np.ndarray, "n v"]
    weights: Float[np.ndarray, "n v"]
    views: UInt16[np.ndarray, "n v"]

    @property
    def truncation(self) -> float:
        """Distance from a surface, world units, beyond which distances are cut off."""
        return TRUNCATION * self.voxel

    @property
    def coordinates(self) -> Int[np.ndarray, "n 3"]:
        """Coordinates of the blocks: those of their first voxel, divided by 8."""
        return coordinates_of(self.keys)

    def rows_of(self, coordinates: Int[np.ndarray, "k 3"]) -> Int[np.ndarray, " k"]:
        """Returns the rows of the blocks with these coordinates; -1 for blocks that do not exist."""
        if not len(self.keys):
            return np.full(len(coordinates), -1)
        keys = keys_of(coordinates)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[rows] == keys, rows, -1)


def empty_volume(voxel: float, keys: Int[np.ndarray, " n"], memory: int) -> Volume:
    """Returns a volume that no view has seen.

    Args:
        voxel: width of a voxel, world units.
        keys: of its blocks, sorted.
        memory: bytes that it may take.

    Raises:
        InputError: if the blocks take more memory.
    """
    if len(keys) * BYTES > memory:
        raise InputError(
            f"A mesh with voxels of {voxel:.4g} needs {len(keys) * BYTES / 1e9:.2g} GB of memory, and may "
            f"take {memory / 1e9:.2g} GB. Use larger voxels.",
            options=("voxel",),
        )
    shape = (len(keys), VOXELS)
    distances, weights = (np.zeros(shape, np.float32) for _ in range(2))
    return Volume(voxel, keys, distances, weights, np.zeros(shape, np.uint16))


def blocks_around(points: Float[np.ndarray, "n 3"], voxel: float) -> Int[np.ndarray, " k"]:
    """Returns the keys of the blocks within the truncation of any point, sorted.

    A cube of the truncation around a point is as wide as a block, so the blocks at its corners are all.

    Raises:
        InputError: if a point is too far from the origin for voxels of this size.
    """
    reach = TRUNCATION * voxel
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T * reach
    scaled = points[:, None, :] / voxel / SIDE
    if len(points) and not np.abs(scaled).max() < FARTHEST - 1:
        raise InputError(
            f"Voxels of {voxel:.4g} are too small for a scene that reaches {np.abs(points).max():.4g} from "
            "its origin. Use larger voxels.",
            options=("voxel",),
        )
    blocks = np.floor(scaled + corners[None] / voxel / SIDE).astype(np.int64)
    return np.unique(keys_of(blocks.reshape(-1, 3)))


def keys_of(coordinates: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Returns one number for each block, by which blocks are sorted."""
    x, y, z = (coordinates.astype(np.int64) + FARTHEST).T
    return (x << 2 * BITS) | (y << BITS) | z


def coordinates_of(keys: Int[np.ndarray, " n"]) -> Int[np.ndarray, "n 3"]:
    """Returns the coordinates of blocks from their keys."""
    mask = (1 << BITS) - 1
    return np.stack([keys >> 2 * BITS, (keys >> BITS) & mask, keys & mask], axis=1) - FARTHEST
