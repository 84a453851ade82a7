"""Distances between neighbouring points, for the first size of Gaussians."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree


def mean_squared_distances(points: Float[np.ndarray, "n 3"], neighbours: int = 3) -> Float[np.ndarray, " n"]:
    """Mean squared distance of each point to its nearest others, at most `neighbours` of them.

    A point that has no other gets zero.
    """
    others = min(neighbours, len(points) - 1)
    if others <= 0:
        return np.zeros(len(points), points.dtype)
    distances, _ = cKDTree(points).query(points, others + 1)
    return np.mean(np.square(distances[:, 1:]), axis=1).astype(points.dtype)
