"""Codebooks represent their numbers about as well as optimal ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from splatax.math import clusters, morton


def test_few_distinct_numbers_are_kept_exactly():
    values = np.array([3.0, -1.0, 3.0, 7.5, -1.0], np.float32)
    codes, labels = clusters.codebook(values, 8)
    assert len(codes) == 8
    assert_array_equal(codes[labels], values)


def test_each_number_takes_its_nearest_code():
    values = np.random.default_rng(0).normal(size=5000).astype(np.float32)
    codes, labels = clusters.codebook(values, 16)
    assert_array_equal(np.abs(values - codes[labels]), np.abs(values[:, None] - codes).min(axis=1))


def test_codebook_of_a_normal_is_as_good_as_theory_allows():
    """Panter and Dite: the least error of K levels is (sqrt(3) pi / 2) / K^2 of the variance."""
    values = np.random.default_rng(0).normal(size=200_000).astype(np.float32)
    codes, labels = clusters.codebook(values, 256)
    best = np.sqrt(3) * np.pi / 2 / 256**2
    assert np.mean(np.square(values - codes[labels])) < 1.15 * best


def test_weighted_numbers_are_nearer_to_their_codes():
    values = np.random.default_rng(0).uniform(size=20_000).astype(np.float32)
    codes, labels = clusters.codebook(values, 64, weights=np.where(values > 0.5, 1000.0, 1.0))
    error = np.abs(values - codes[labels])
    assert error[values > 0.5].mean() < 0.3 * error[values <= 0.5].mean()


def test_palette_is_as_good_as_plain_k_means():
    rng = np.random.default_rng(0)
    vectors = (rng.normal(size=(4000, 3)) @ rng.normal(size=(3, 9))).astype(np.float32)
    centres, labels = clusters.palette(vectors, 1024)
    assert centres.shape == (1024, 9)
    plain = clusters._lloyd(vectors, 1024, 20, rng)
    of_plain = np.sum(np.square(vectors - plain[clusters.nearest(vectors, plain)]))
    assert np.sum(np.square(vectors - centres[labels])) < 1.1 * of_plain


def test_palette_holds_all_when_there_is_room():
    vectors = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    centres, labels = clusters.palette(vectors, 1024)
    assert_array_equal(centres[labels], vectors)


@pytest.mark.parametrize("kind", ["equal", "two", "one far"])
def test_palette_of_degenerate_vectors(kind):
    vectors = np.zeros((3000, 4), np.float32)
    if kind == "two":
        vectors[::2] = 1
    if kind == "one far":
        vectors[7] = 1e4
    centres, labels = clusters.palette(vectors, 1024)
    assert_allclose(centres[labels], vectors, atol=1e-6)


@pytest.mark.slow
def test_palette_of_a_large_scene_takes_seconds():
    """150,000 Gaussians of degree 3 and 65,536 entries: n * size distances would take an hour."""
    import time

    rng = np.random.default_rng(0)
    vectors = (rng.normal(size=(150_000, 9)) @ rng.normal(size=(9, 45))).astype(np.float32)
    started = time.process_time()
    centres, labels = clusters.palette(vectors, 65_536)
    assert time.process_time() - started < 60
    assert np.mean(np.square(vectors - centres[labels])) < 0.1 * vectors.var()


def test_morton_order_visits_octants_one_by_one():
    points = np.random.default_rng(0).uniform(size=(1000, 3)).astype(np.float32)
    points[:2] = [[0, 0, 0], [1, 1, 1]]
    order = morton.order(points)
    assert sorted(order) == list(range(1000))
    octant = (points[order] >= 0.5) @ [1, 2, 4]
    assert (np.diff(octant) >= 0).all()
    inner = points[order][octant == 5] * 4 % 2 >= 1
    assert (np.diff(inner @ [1, 2, 4]) >= 0).all()


def test_morton_order_of_no_points_and_of_equal_points():
    assert len(morton.order(np.zeros((0, 3), np.float32))) == 0
    assert_array_equal(morton.order(np.ones((4, 3), np.float32)), np.arange(4))
