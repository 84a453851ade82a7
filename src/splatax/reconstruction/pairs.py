"""Selects the pairs of photos to match: all pairs, pairs of similar photos, or neighbours in a video.

The similarity of two photos is the number of their largest features that match. It is counted for all
pairs of up to `COMPARED` photos, and in larger sets only for photos that an index of visual words suggests:
all pairs of 5,000 photos would take more than an hour.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.reconstruction.visual_words import suggested

if TYPE_CHECKING:
    import pycolmap

Pair = tuple[int, int]  # positions of two photos in the order of their names, the smaller first

FEATURES = 200  # largest features of each photo that are compared (preemptive matching, Wu 2013)
RATIO = 0.8  # limit of the ratio of distances to the best and second best match (Lowe 2004)
FEWEST = 4  # matches that two similar photos have at least
BLOCK = 64  # photos that one photo is compared with at a time
COMPARED = 300  # photos of which all pairs are compared, which takes 15 seconds on one core
SPARE = 10  # photos to compare, more than are looked for, in larger sets


@dataclass(frozen=True)
class Exhaustive:
    """Pairs of every photo with every other."""

    def pairs(self, database: "pycolmap.Database", ids: list[int]) -> list[Pair]:
        return [(i, j) for i in range(len(ids)) for j in range(i + 1, len(ids))]


@dataclass(frozen=True)
class Similar:
    """Pairs of each photo with those that share most of its largest features, and with the next by name."""

    neighbours: int = 30
    following: int = 3

    def pairs(self, database: "pycolmap.Database", ids: list[int]) -> list[Pair]:
        return sorted(
            alike(database, ids, self.neighbours) | following(len(ids), range(1, self.following + 1))
        )


@dataclass(frozen=True)
class Sequential:
    """Pairs of each frame with the next ones, with some later ones, and with similar ones to close loops."""

    overlap: int = 8
    doublings: int = 5  # later frames at 2, 4, ... times the overlap
    neighbours: int = 5

    def pairs(self, database: "pycolmap.Database", ids: list[int]) -> list[Pair]:
        steps = [*range(1, self.overlap + 1), *(self.overlap << i for i in range(1, self.doublings + 1))]
        return sorted(alike(database, ids, self.neighbours) | following(len(ids), steps))


Pairing = Exhaustive | Similar | Sequential


def following(count: int, steps: Iterable[int]) -> set[Pair]:
    """Returns pairs of photos at these distances in the order of names."""
    return {(i, i + step) for step in steps for i in range(count - step)}


def alike(database: "pycolmap.Database", ids: list[int], neighbours: int) -> set[Pair]:
    """Returns pairs of photos of which one is among the most similar to the other."""
    return similar([largest(database, image) for image in ids], neighbours)


def similar(features: list[Float[np.ndarray, "k 128"]], neighbours: int) -> set[Pair]:
    """Returns pairs of photos of which one is among the most similar to the other.

    Args:
        features: unit descriptors of each photo, padded with zeros; see `largest`.
        neighbours: number of photos that are paired with each.
    """
    every = np.arange(len(features))
    if len(features) <= COMPARED:
        candidates = [every[i + 1 :] for i in every]
    else:
        candidates = suggested(features, neighbours + SPARE)
    found: list[list[tuple[float, int]]] = [[] for _ in features]  # (minus the number of matches, photo)
    for i, others in enumerate(candidates):
        for start in range(0, len(others), BLOCK):
            block = others[start : start + BLOCK]
            counts = shared(features[i], [features[j] for j in block])
            for j, count in zip(block.tolist(), counts.tolist(), strict=True):
                if count >= FEWEST:
                    found[i].append((-count, j))
                    found[j].append((-count, i))
    best = ((i, j) for i, others in enumerate(found) for _, j in sorted(others)[:neighbours])
    return {(min(i, j), max(i, j)) for i, j in best}


def largest(database: "pycolmap.Database", image: int) -> Float[np.ndarray, "k 128"]:
    """Returns the unit descriptors of a photo's largest features, padded with zeros."""
    chosen = np.zeros((FEATURES, 128), np.float32)
    if database.exists_descriptors(image):
        keypoints, descriptors = database.read_keypoints(image), database.read_descriptors(image).data
        a, b, c, d = keypoints[:, 2:6].T  # affine shape
        scales = np.abs(a * d - b * c)
        best = np.asarray(descriptors)[np.argsort(-scales, kind="stable")[:FEATURES]].astype(np.float32)
        chosen[: len(best)] = best / np.maximum(np.linalg.norm(best, axis=1, keepdims=True), 1e-9)
    return chosen


def shared(
    features: Float[np.ndarray, "k 128"], others: list[Float[np.ndarray, "k 128"]]
) -> Float[np.ndarray, " m"]:
    """Returns the number of features that have a distinct match in each of the other photos."""
    products = (features @ np.concatenate(others).T).reshape(FEATURES, len(others), FEATURES)
    at = products.argmax(axis=2)[..., None]
    best = np.take_along_axis(products, at, axis=2)[..., 0]
    np.put_along_axis(products, at, -np.inf, axis=2)
    second = products.max(axis=2)
    # Distances of unit vectors: |a - b|^2 = 2 - 2 a.b
    distinct = (2 - 2 * best) < RATIO**2 * (2 - 2 * second)
    return np.sum(distinct & (best > 0), axis=0).astype(np.float64)
