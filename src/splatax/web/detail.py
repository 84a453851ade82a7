"""Previews of large scenes: the few Gaussians that a page shows before it has read all of them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.editing.levels import covariances_of, matched, weights_of
from splatax.gaussians import Gaussians

LOD_ABOVE = 300_000  # Gaussians of a page, above which it has previews and level of detail
PREVIEW = 60_000  # Gaussians of all previews of a page
LARGEST = 0.25  # fraction of a file's Gaussians that its preview has at most
SMALLEST = 500  # files of fewer Gaussians have no preview


def previews_of(files: Mapping[str, Gaussians], above: int) -> dict[str, Gaussians]:
    """Returns a coarser version of each file of a page, by the file's name.

    Together the versions have about 60,000 Gaussians, or a quarter of the page's if that is less. A page of
    at most `above` Gaussians has none, and neither have files of fewer than 500.

    Args:
        files: Gaussians of the page by file, in Morton order, without broken ones and empty slots.
        above: number of Gaussians.
    """
    total = sum(map(len, files.values()))
    if total <= above:
        return {}
    fraction = min(PREVIEW / total, LARGEST)
    return {
        file: preview(gaussians, max(round(fraction * len(gaussians)), 1))
        for file, gaussians in files.items()
        if len(gaussians) >= SMALLEST
    }


def preview(gaussians: Gaussians, count: int) -> Gaussians:
    """Returns `count` Gaussians, each of which has the weight, mean and covariance of a run of neighbours.

    It is faster and coarser than `editing.coarser`, which chooses neighbours that look alike: a second for a
    million Gaussians instead of minutes.

    Args:
        gaussians: at least `count`, in Morton order, without broken ones and empty slots.
        count: number of runs.
    """
    starts = np.arange(count) * len(gaussians) // count
    lengths = np.diff(np.append(starts, len(gaussians)))
    weights = weights_of(gaussians)
    totals = np.add.reduceat(weights, starts)
    within_run = weights / np.repeat(totals, lengths)

    def mean(values: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "m ..."]:
        by = within_run.reshape(-1, *[1] * (values.ndim - 1)).astype(values.dtype)
        return np.add.reduceat(by * values, starts, axis=0)

    means = np.asarray(gaussians.means, np.float64)
    middle = mean(means)
    away = means - np.repeat(middle, lengths, axis=0)
    covariance = mean(covariances_of(gaussians) + away[:, :, None] * away[:, None, :])
    merged = matched(middle, covariance, totals) | {"sh": mean(np.asarray(gaussians.sh))}
    dtype = gaussians.means.dtype
    fields: dict[str, Any] = {name: jnp.asarray(values, dtype) for name, values in merged.items()}
    return replace(gaussians, **fields)
