"""Pairs of photos to match."""

import numpy as np
import pycolmap
import pytest

from splatax.reconstruction import mapping
from splatax.reconstruction import pairs as pairs_module
from splatax.reconstruction.pairs import FEATURES, Exhaustive, Sequential, Similar, following


@pytest.fixture
def database(tmp_path):
    with mapping.opened(tmp_path / "database.db") as opened:
        yield opened


def fill(database, places) -> list[int]:
    """Photos; those of one place show the same features, in another order. None shows nothing."""
    mapping.register(database, [mapping.Entry(f"{i}.jpg", (40, 30), None, "") for i in range(len(places))])
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
