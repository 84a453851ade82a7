"""Similarity transforms between two sets of points, in two or three dimensions."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

TRIALS = 300  # triples of points that are tried; with half of the points wrong, one in eight is right
ROUNDS = 30  # of reweighting
FAR = 3.0  # standard deviations from which a point counts as wrong
MEDIAN_NORM = {2: 1.1774, 3: 1.5382}  # median length of a normal vector of standard deviation 1, by dimension


class Alignment(NamedTuple):
    """The transform target = scale R point + translation between two sets of points.

    Attributes:
        scale: a factor, not below zero.
        rotation: R.
        translation: in the frame of the targets.
    """

    scale: float
    rotation: Float[np.ndarray, "d d"]
    translation: Float[np.ndarray, " d"]

    def distances(
        self, points: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "n d"]
    ) -> Float[np.ndarray, " n"]:
        """Returns the distance of each transformed point from its target."""
        return np.linalg.norm(self.scale * points @ self.rotation.T + self.translation - targets, axis=1)


def aligned(
    points: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]
) -> Alignment:
    """Returns the similarity with the least weighted sum of squared distances (Umeyama 1991)."""
    weights = weights / weights.sum()
    middles = weights @ points, weights @ targets
    here, there = points - middles[0], targets - middles[1]
    left, singular, right = np.linalg.svd(there.T @ (weights[:, None] * here))
    signs = np.ones(len(singular))
    signs[-1] = np.sign(np.linalg.det(left) * np.linalg.det(right)) or 1.0
    rotation = (left * signs) @ right
    variance = float(weights @ np.sum(here * here, axis=1))
    scale = max(float(singular @ signs), 0.0) / variance if variance > 0 else 0.0
    return Alignment(scale, rotation, middles[1] - scale * rotation @ middles[0])


def robustly_aligned(
    points: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "n d"], error: float, seed: int = 0
) -> tuple[Alignment, Bool[np.ndarray, " n"]]:
    """Returns a similarity that up to about half of the points may contradict, and the points that agree.

    The best of the similarities of random triples, by the median distance, is refined with the weights of a
    Cauchy distribution, and then by the points that agree.

    Args:
        points: at least three.
        targets: their places in the other frame.
        error: expected distance of a target from its true place, in units of the targets. Distances below
            three times this do not make a point wrong.
        seed: of the random triples.
    """
    count, dimensions = points.shape
    rng, even = np.random.default_rng(seed), np.ones(3)
    triples = [rng.choice(count, 3, replace=False) for _ in range(TRIALS)]
    candidates = [aligned(points[rows], targets[rows], even) for rows in triples]
    found = min(candidates, key=lambda each: float(np.median(each.distances(points, targets))))
    for _ in range(ROUNDS):
        distances = found.distances(points, targets)
        found = aligned(points, targets, 1 / (1 + (distances / _width(distances, error, dimensions)) ** 2))
    distances = found.distances(points, targets)
    agree = distances <= FAR * _width(distances, error, dimensions)
    return aligned(points[agree], targets[agree], np.ones(int(agree.sum()))), agree


def _width(distances: Float[np.ndarray, " n"], error: float, dimensions: int) -> float:
    """Returns the standard deviation that distances have, but not less than the expected error."""
    return max(float(np.median(distances)) / MEDIAN_NORM[dimensions], error)
