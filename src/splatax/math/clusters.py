"""Vector quantization: codebooks of numbers and of vectors, by k-means (Lloyd 1982)."""

import numpy as np
from jaxtyping import Float, Int

GROUP = 256  # clusters of the first level, and about the number of entries in each group of the second
SAMPLE = 20_000  # vectors that the first level is computed from


def codebook(
    values: Float[np.ndarray, " n"],
    size: int,
    *,
    weights: Float[np.ndarray, " n"] | None = None,
    rounds: int = 30,
) -> tuple[Float[np.ndarray, " size"], Int[np.ndarray, " n"]]:
    """Returns a codebook of `size` increasing numbers, and the index of the entry for each value.

    The initial spacing is the one that is optimal for many levels, density^(1/3) (Panter and Dite
    1951). Since the values are sorted, a round of Lloyd's algorithm is a few binary searches and sums.

    Args:
        values: numbers to quantize.
        size: number of entries; the last one is repeated if there are fewer distinct values.
        weights: weight of each value's squared error, above zero; all the same if None.
        rounds: number of rounds of Lloyd's algorithm.
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order].astype(np.float64)
    distinct = ordered[np.concatenate([[True], np.diff(ordered) > 0])]
    if len(distinct) <= size:
        centres = np.concatenate([distinct, np.full(size - len(distinct), distinct[-1])])
        return centres.astype(np.float32), np.searchsorted(distinct, values.astype(np.float64))
    weight = np.ones(len(values)) if weights is None else weights[order].astype(np.float64)
    density, edges = np.histogram(ordered, bins=8 * size, weights=weight)
    cumulative = np.concatenate([[0], np.cumsum(np.cbrt(density))])
    centres = np.interp(np.arange(size) / (size - 1) * cumulative[-1], cumulative, edges)
    total, sums = (np.concatenate([[0], np.cumsum(w)]) for w in (weight, weight * ordered))
    for _ in range(rounds):
        ends = np.searchsorted(ordered, (centres[1:] + centres[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        heavy = np.diff(total[ends]) > 0
        means = np.diff(sums[ends]) / np.where(heavy, np.diff(total[ends]), 1)
        centres = np.sort(np.where(heavy, means, centres))
    return centres.astype(np.float32), np.searchsorted((centres[1:] + centres[:-1]) / 2, values)


def palette(
    vectors: Float[np.ndarray, "n d"], size: int, *, rounds: int = 8, seed: int = 0
) -> tuple[Float[np.ndarray, "size d"], Int[np.ndarray, " n"]]:
    """Returns a palette of `size` vectors, and the index of the entry for each vector.

    Two levels of clustering take n (256 + size / 256) distances a round instead of n size: vectors are
    first divided into 256 groups, then each group gets entries in proportion to its squared error.

    Args:
        vectors: vectors to quantize.
        size: number of entries; zeros fill the palette if there are fewer vectors.
        rounds: number of rounds of Lloyd's algorithm on each level.
        seed: random seed.
    """
    rng = np.random.default_rng(seed)
    n = len(vectors)
    if n <= size:
        return np.concatenate([vectors, np.zeros((size - n, vectors.shape[1]), vectors.dtype)]), np.arange(n)
    groups = min(GROUP, max(1, size // GROUP))
    sample = vectors[rng.choice(n, min(n, SAMPLE), replace=False)]
    coarse = _lloyd(sample, groups, rounds, rng)
    group_of = nearest(vectors, coarse)
    error = np.sum(np.square(vectors - coarse[group_of]), axis=1)
    counts = np.bincount(group_of, minlength=groups)
    entries = _entries_of(np.bincount(group_of, error, groups), counts, size)

    centres = np.zeros((size, vectors.shape[1]), np.float32)
    labels = np.zeros(n, int)
    first = 0
    for group in range(groups):
        rows = np.flatnonzero(group_of == group)
        if len(rows) == 0:
            continue
        own = _lloyd(vectors[rows], int(entries[group]), rounds, rng)
        centres[first : first + len(own)] = own
        labels[rows] = first + nearest(vectors[rows], own)
        first += len(own)
    return centres, labels


def nearest(vectors: Float[np.ndarray, "n d"], centres: Float[np.ndarray, "k d"]) -> Int[np.ndarray, " n"]:
    """Returns the index of the centre nearest to each vector."""
    half = np.sum(np.square(centres), axis=1) / 2
    chunk = max(1, (1 << 24) // max(1, len(centres)))  # 64 MB of distances at a time
    parts = [
        np.argmin(half - vectors[start : start + chunk] @ centres.T, axis=1)
        for start in range(0, len(vectors), chunk)
    ]
    return np.concatenate(parts) if parts else np.zeros(0, int)


def _lloyd(vectors: np.ndarray, size: int, rounds: int, rng: np.random.Generator) -> np.ndarray:
    """Returns at most `size` centres. A centre without vectors moves to one with a large error."""
    if len(vectors) <= size:
        return vectors
    centres = vectors[rng.choice(len(vectors), size, replace=False)]
    for _ in range(rounds):
        labels = nearest(vectors, centres)
        counts = np.bincount(labels, minlength=size)
        order = np.argsort(labels, kind="stable")
        used = np.flatnonzero(counts)
        sums = np.add.reduceat(vectors[order], (np.cumsum(counts) - counts)[used], axis=0)
        idle = np.flatnonzero(counts == 0)
        centres[used] = sums / counts[used, None]
        if len(idle):
            errors = np.sum(np.square(vectors - centres[labels]), axis=1)
            centres[idle] = vectors[np.argsort(-errors)[: len(idle)]]
    return centres


def _entries_of(errors: np.ndarray, counts: np.ndarray, size: int) -> np.ndarray:
    """Returns the number of entries of each group: in proportion to its error, from 1 to its count."""
    least = (counts > 0).astype(float)
    entries = least.copy()
    for _ in range(20):  # entries that a full group cannot take go to the others
        open_ = (entries < counts) & (errors > 0)
        left = size - entries.sum()
        if left < 1 or not open_.any():
            break
        entries = np.minimum(entries + np.where(open_, errors, 0) / errors[open_].sum() * left, counts)
    return np.maximum(np.floor(entries), least).astype(int)
