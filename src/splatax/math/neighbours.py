"""Distances between neighbouring points, for the initial size of Gaussians."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree


def mean_squared_distances(points: Float[np.ndarray, "n 3"], neighbours: int = 3) -> Float[np.ndarray, " n"]:
    """Returns the mean squared distance of each point to its `neighbours` nearest other points.

    If there are fewer other points, the mean is over all of them; a single point gets zero.
    """
    others = min(neighbours, len(points) - 1)
    if others <= 0:
        return np.zeros(len(points), points.dtype)
    distances, _ = cKDTree(points).query(points, others + 1)
    return np.mean(np.square(distances[:, 1:]), axis=1).astype(points.dtype)
