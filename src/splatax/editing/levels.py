"""Levels of detail: scenes of fewer Gaussians, each of which stands for several neighbours.

A pair of neighbours becomes one Gaussian with the same total weight, mean and covariance (moment matching),
as in hierarchies of Gaussians (Kerbl et al. 2024, section 4.1). Pairs that look alike and lie close to each
other go first.
"""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from splatax.gaussians import Gaussians

NEIGHBOURS = 6
SMALLEST = 20_000  # Gaussians; below, another level saves nothing
FRACTION = 0.25  # of the Gaussians of a level are in the next
COLORS = 4.0  # weight of a difference of colours, beside one of places in units of size


def levels_of(gaussians: Gaussians, count: int | None = None) -> tuple[Gaussians, ...]:
    """Returns a scene and coarser ones, each with a quarter of the Gaussians of the one before.

    Args:
        gaussians: the scene; level 0.
        count: number of levels; None for as many as have more than 20,000 Gaussians, and level 0.
    """
    levels = [gaussians]
    while len(levels) < count if count else FRACTION * len(levels[-1]) > SMALLEST:
        levels.append(coarser(levels[-1], max(round(FRACTION * len(levels[-1])), 1)))
    return tuple(levels)


def coarser(gaussians: Gaussians, count: int) -> Gaussians:
    """Returns a scene of `count` Gaussians that looks similar from afar.

    Args:
        gaussians: the scene, without empty slots.
        count: number of Gaussians to keep; the scene is returned as it is if it has no more.
    """
    while len(gaussians) > count:
        first, second = _pairs(gaussians, len(gaussians) - count)
        gaussians = _merged(gaussians, first, second)
    return gaussians


def weights_of(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """Returns opacity times area of the largest cross section, about what a Gaussian adds to pictures."""
    two_largest = np.sort(np.asarray(gaussians.log_scales, np.float64), axis=1)[:, 1:].sum(axis=1)
    return (
        expit(np.asarray(gaussians.opacity_logits, np.float64)) * np.exp(np.minimum(two_largest, 80)) + 1e-30
    )


def covariances_of(gaussians: Gaussians) -> Float[np.ndarray, "n 3 3"]:
    """Returns covariances by NumPy: JAX would compile a program for each round, as each has fewer rows."""
    quats = np.asarray(gaussians.quats, np.float64)
    quats = np.where(quats.any(axis=1, keepdims=True), quats, [1.0, 0, 0, 0])
    turned = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    factors = turned * np.exp(np.asarray(gaussians.log_scales, np.float64))[:, None]
    return factors @ factors.swapaxes(1, 2)


def _pairs(gaussians: Gaussians, most: int) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Returns the rows of disjoint pairs, at most so many: neighbours that are each other's best partner."""
    means = np.asarray(gaussians.means, np.float64)
    size = np.exp(np.minimum(np.asarray(gaussians.log_scales, np.float64), 40)).max(axis=1)
    colors = np.asarray(gaussians.sh)[:, 0].astype(np.float64)
    weights = weights_of(gaussians)
    others = min(NEIGHBOURS, len(means) - 1)
    _, near = cKDTree(means).query(means, k=others + 1)
    rows = np.arange(len(means))[:, None]
    near = np.where(near[:, 1:] == rows, near[:, :1], near[:, 1:])  # where places are equal, not itself
    apart = np.sum((means[near] - means[:, None]) ** 2, axis=-1) / (size[near] ** 2 + size[:, None] ** 2)
    unlike = COLORS * np.sum((colors[near] - colors[:, None]) ** 2, axis=-1)
    costs = np.minimum(weights[near], weights[:, None]) * (apart + unlike + 0.01)
    best = np.argmin(costs, axis=1)
    partner, cost = near[rows[:, 0], best], costs[rows[:, 0], best]
    mutual = np.flatnonzero((partner[partner] == rows[:, 0]) & (rows[:, 0] < partner))
    if len(mutual) == 0:  # ties in a circle
        mutual = np.array([np.argmin(cost)])
    chosen = mutual[np.argsort(cost[mutual], kind="stable")[:most]]
    return chosen, partner[chosen]


def _merged(gaussians: Gaussians, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]) -> Gaussians:
    """Returns the scene with each pair of rows replaced by one Gaussian, in the place of the first."""
    weights = weights_of(gaussians)
    fractions = (weights[first] / (weights[first] + weights[second]))[:, None]

    def mean(values: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "p ..."]:
        by = fractions.reshape(-1, *[1] * (values.ndim - 1))
        return by * values[first] + (1 - by) * values[second]

    means = np.asarray(gaussians.means, np.float64)
    middle = mean(means)
    covariance = mean(covariances_of(gaussians))
    for rows, by in ((first, fractions), (second, 1 - fractions)):
        away = means[rows] - middle
        covariance += by[..., None] * away[:, :, None] * away[:, None, :]
    kept = np.ones(len(means), bool)
    kept[second] = False

    def replaced(column: Float[Array, "n ..."], values: Float[np.ndarray, "p ..."]) -> Float[Array, "m ..."]:
        rows = np.array(column)
        rows[first] = values
        return jnp.asarray(rows[kept])

    merged = matched(middle, covariance, weights[first] + weights[second])
    merged["sh"] = mean(np.asarray(gaussians.sh, np.float64))
    fields: dict[str, Any] = {name: replaced(getattr(gaussians, name), merged[name]) for name in merged}
    return replace(gaussians, **fields)


def matched(
    means: Float[np.ndarray, "p 3"], covariances: Float[np.ndarray, "p 3 3"], weights: Float[np.ndarray, " p"]
) -> dict[str, Float[np.ndarray, "p ..."]]:
    """Returns the fields of Gaussians with these moments, except for colours.

    Args:
        means: centres, world units.
        covariances: world units squared.
        weights: opacity times area of the largest cross section, world units squared.
    """
    variances, axes = np.linalg.eigh(covariances)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    scales = np.sqrt(np.maximum(variances, 1e-24))
    opacities = np.clip(weights / np.maximum(scales[:, 1] * scales[:, 2], 1e-30), 1e-4, 0.9999)
    return {
        "means": means,
        "quats": Rotation.from_matrix(axes).as_quat(scalar_first=True),
        "log_scales": np.log(scales),
        "opacity_logits": np.log(opacities) - np.log1p(-opacities),
    }
