"""An index of photos by visual words: it suggests which photos of a large set may show the same.

A visual word is a cluster of feature descriptors (Sivic and Zisserman 2003). Words are found on two levels,
so that a feature is compared with a few hundred centres instead of all (Nister and Stewenius 2006). The same
features give the same suggestions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from splatax.math.clusters import nearest, palette

if TYPE_CHECKING:
    from scipy import sparse

COARSE, FINE = 128, 128  # clusters of the first level, and clusters in each of these
TAUGHT = 1 << 17  # features that the words are computed from
ROUNDS = 5  # of k-means
ROWS = 256  # photos that are described, or compared with all others, at a time

Features = Sequence[Float[np.ndarray, "k 128"]]  # of each photo


@dataclass(frozen=True)
class Vocabulary:
    """Visual words on two levels.

    Attributes:
        coarse: centres of the first level.
        fine: centres of the words in each cluster of the first level.
    """

    coarse: Float[np.ndarray, "c 128"]
    fine: tuple[Float[np.ndarray, "_ 128"], ...]

    def words_of(self, features: Float[np.ndarray, "n 128"]) -> Int[np.ndarray, " n"]:
        """Returns the number of the word of each feature."""
        cells = nearest(features, self.coarse)
        words = np.zeros(len(features), int)
        for cell in np.unique(cells):
            rows = np.flatnonzero(cells == cell)
            words[rows] = cell * FINE + nearest(features[rows], self.fine[cell])
        return words


def suggested(features: Features, most: int) -> list[Int[np.ndarray, " _"]]:
    """Returns for each photo the later photos to compare it with, in increasing order.

    A photo is described by how often each word is in it, weighted by the word's rarity. Two photos are
    suggested if one is among the `most` photos whose descriptions are nearest to the other's.

    Args:
        features: descriptors of each photo as unit vectors; rows of zeros do not count.
        most: number of photos to look for, for each photo.
    """
    described = descriptions(features)
    first = [np.zeros(0, int)]
    second = [np.zeros(0, int)]
    for start in range(0, len(features), ROWS):
        similarity = (described[start : start + ROWS] @ described.T).toarray()
        here = np.arange(len(similarity))
        similarity[here, start + here] = 0
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :most]
        alike = np.take_along_axis(similarity, best, axis=1).ravel() > 0
        first.append(np.repeat(start + here, best.shape[1])[alike])
        second.append(best.ravel()[alike])
    one, other = np.concatenate(first), np.concatenate(second)
    pairs = np.unique(np.stack([np.minimum(one, other), np.maximum(one, other)], axis=1), axis=0)
    ends = np.searchsorted(pairs[:, 0], np.arange(len(features) + 1))
    return [pairs[start:end, 1] for start, end in pairwise(ends)]


def descriptions(features: Features) -> "sparse.csr_matrix":
    """Returns a row for each photo: the frequencies of its words, weighted by rarity, as a unit vector."""
    from scipy import sparse

    vocabulary = vocabulary_of(features)
    photos, words = [np.zeros(0, int)], [np.zeros(0, int)]
    for start in range(0, len(features), ROWS):
        block = [present(own) for own in features[start : start + ROWS]]
        photos.append(np.repeat(np.arange(start, start + len(block)), [len(own) for own in block]))
        words.append(vocabulary.words_of(np.concatenate(block)))
    shape = len(features), COARSE * FINE
    places = np.concatenate(photos), np.concatenate(words)
    counts = sparse.csr_matrix((np.ones(len(places[0]), np.float32), places), shape)  # adds equal places
    counts.data = np.sqrt(counts.data)  # a word that repeats in one photo, as on a fence, says little more
    photos_with = np.bincount(counts.indices, minlength=shape[1])
    rarity = np.log(shape[0] / np.maximum(photos_with, 1)).astype(np.float32)
    weighted = counts @ sparse.diags(rarity)
    lengths = np.sqrt(np.asarray(weighted.multiply(weighted).sum(axis=1)).ravel())
    return sparse.csr_matrix(sparse.diags((1 / np.maximum(lengths, 1e-12)).astype(np.float32)) @ weighted)


def vocabulary_of(features: Features) -> Vocabulary:
    """Returns the words of a sample of the features."""
    counts = np.array([np.count_nonzero(np.any(own, axis=1)) for own in features])
    ends = np.cumsum(counts)
    total = int(counts.sum())
    chosen = np.sort(np.random.default_rng(0).choice(total, min(total, TAUGHT), replace=False))
    parts = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
    sample = np.concatenate(
        [
            present(own)[part - (end - n)]
            for own, part, end, n in zip(features, parts, ends, counts, strict=True)
        ]
    )
    coarse, cells = palette(sample, COARSE, rounds=ROUNDS)
    return Vocabulary(
        coarse, tuple(palette(sample[cells == cell], FINE, rounds=ROUNDS)[0] for cell in range(COARSE))
    )


def present(features: Float[np.ndarray, "k 128"]) -> Float[np.ndarray, "_ 128"]:
    """Returns the rows that are not zero."""
    return features[np.any(features, axis=1)]
