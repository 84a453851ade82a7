"""Pairs of photos to match."""

import numpy as np
import pycolmap
import pytest

from splatax.reconstruction import mapping
from splatax.reconstruction import pairs as pairs_module
from splatax.reconstruction.pairs import FEATURES, Exhaustive, Sequential, Similar, following
from splatax.reconstruction.visual_words import suggested


@pytest.fixture
def database(tmp_path):
    with mapping.opened(tmp_path / "database.db") as opened:
        yield opened


def fill(database, places) -> list[int]:
    """Photos; those of one place show the same features, in another order. None shows nothing."""
    mapping.register(database, [[mapping.Entry(f"{i}.jpg", (40, 30), None, "")] for i in range(len(places))])
    ids = sorted(image.image_id for image in database.read_all_images())
    with pycolmap.DatabaseTransaction(database):
        for image, place in zip(ids, places, strict=True):
            if place is None:
                continue
            shown = np.random.default_rng(place).integers(0, 255, (FEATURES, 128), np.uint8)
            shuffled = np.random.default_rng(100 + image).permutation(shown)
            scales = np.linspace(9, 1, FEATURES)
            nothing = np.zeros(FEATURES)
            keypoints = np.column_stack([nothing, nothing, scales, nothing, nothing, scales])
            database.write_keypoints(image, keypoints.astype(np.float32))
            sift = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(image, pycolmap.FeatureDescriptors(type=sift, data=shuffled))
    return ids


def test_all_pairs_once(database):
    assert Exhaustive().pairs(database, [7, 8, 9]) == [(0, 1), (0, 2), (1, 2)]


def test_photos_of_one_place_are_paired_wherever_they_are_in_the_order(database):
    ids = fill(database, [1, 2, 1, 3, 2, None, 1])
    pairs = Similar(neighbours=3, following=0).pairs(database, ids)
    assert pairs == [(0, 2), (0, 6), (1, 4), (2, 6)]


def test_many_photos_are_compared_in_blocks(database, monkeypatch):
    monkeypatch.setattr(pairs_module, "BLOCK", 4)
    ids = fill(database, [*range(9), 5])
    pairs = Similar(neighbours=3, following=0).pairs(database, ids)
    assert pairs == [(5, 9)]


def test_frames_are_paired_with_the_next_and_with_some_far_on(database):
    pairs = Sequential(overlap=2, doublings=2, neighbours=1).pairs(database, fill(database, [None] * 12))
    assert {j - i for i, j in pairs} == {1, 2, 4, 8}
    assert len(pairs) == len(set(pairs))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_no_pair_reaches_beyond_the_last(count):
    assert all(j < count for _, j in following(count, range(1, 9)))


def test_the_index_of_a_large_set_finds_the_pairs_that_comparing_all_photos_finds(database, monkeypatch):
    """Photos of five places in turn, in which no feature looks the same twice."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 255, (5, FEATURES, 128))
    ids = fill(database, [None] * 40)
    shown = [np.clip(places[i % 5] + rng.normal(0, 12, (FEATURES, 128)), 0, 255) for i in range(40)]
    features = dict(zip(ids, (f / np.linalg.norm(f, axis=1, keepdims=True) for f in shown), strict=True))
    monkeypatch.setattr(pairs_module, "largest", lambda _, image: features[image].astype(np.float32))
    compared = Similar(neighbours=7, following=0).pairs(database, ids)
    monkeypatch.setattr(pairs_module, "COMPARED", 10)
    assert Similar(neighbours=7, following=0).pairs(database, ids) == compared
    assert compared == [(i, j) for i in range(40) for j in range(i + 5, 40, 5)]


def test_the_index_suggests_a_few_photos_of_many_and_knows_nothing_of_empty_ones():
    rng = np.random.default_rng(0)
    features = [np.zeros((4, 128), np.float32), *rng.random((5, 4, 128)).astype(np.float32)]
    found = suggested([*features, *features[1:]], 1)
    assert [others.tolist() for others in found[:6]] == [[], [6], [7], [8], [9], [10]]
    assert not any(len(others) for others in suggested([features[0]] * 3, 2))
