"""Decoded photos on disk: the same bits, shared, limited in size, and replaced if they are damaged."""

import os
import shutil
from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import splatax as sx
from captures import radial, write_capture
from splatax.dataset import Edited
from splatax.io import photo_store
from splatax.io.datasets import decoding
from splatax.io.memory import Allowance
from splatax.io.photo_store import PhotoStore, kept_on_disk


@pytest.fixture
def store(tmp_path):
    return PhotoStore(tmp_path / "store", 10**9)


def with_masks(folder):
    (folder / "masks").mkdir()
    for i, photo in enumerate(sorted((folder / "images").iterdir())):
        mask = np.zeros((48, 64), np.uint8)
        mask[i:30] = 255
        Image.fromarray(mask).save(folder / "masks" / photo.name)
    return folder


def contents(views):
    return [(view.pixels().tobytes(), view.mask and view.mask().tobytes()) for view in views]


@pytest.mark.parametrize("undistort", [False, True])
def test_photos_and_masks_from_disk_are_those_of_the_capture(tmp_path, store, undistort, monkeypatch):
    folder = with_masks(write_capture(tmp_path / "capture", 3, radial()))
    views = sx.load_dataset(folder, undistort=undistort).views
    kept, use = kept_on_disk(views, store)
    assert (use.kept, use.photos) == (3, 3)
    expected = contents(views)
    assert contents(kept) == expected  # decodes and writes
    monkeypatch.setattr(decoding.images, "read", None)
    monkeypatch.setattr(decoding.images, "read_mask", None)
    again, _ = kept_on_disk(sx.load_dataset(folder, undistort=undistort).views, store)
    assert contents(again) == expected
    assert isinstance(again[0].pixels(), np.memmap)


def test_a_photo_is_kept_as_it_is_changed_and_is_changed_once(tmp_path, store):
    view = sx.load_dataset(write_capture(tmp_path / "capture", 1)).views[0]
    before, calls = view.pixels(), []

    def inverted(pixels):
        calls.append(1)
        return 255 - pixels

    edited = replace(view, pixels=Edited(view.pixels, inverted, "inverted"))
    kept, use = kept_on_disk((edited,), store)
    assert use.kept == 1
    for _ in range(3):  # written, then read
        np.testing.assert_array_equal(kept[0].pixels(), 255 - before)
    assert len(calls) == 1
    np.testing.assert_array_equal(kept[0].as_taken().pixels(), before)
    other = replace(view, pixels=Edited(view.pixels, lambda pixels: pixels // 2, "halved"))
    for each, expected in ((other, before // 2), (view, before)):  # not what another change left
        (again,), _ = kept_on_disk((each,), store)
        np.testing.assert_array_equal(again.pixels(), expected)


def test_a_photo_that_changed_or_has_another_size_or_lens_is_another(tmp_path):
    folder = write_capture(tmp_path / "capture", 1, radial())

    def key(**how):
        return sx.load_dataset(folder, **how).views[0].pixels.identity

    first = key()
    keys = {first, key(undistort=True), key(downscale=2), key(downscale=2, undistort=True)}
    assert len(keys) == 4
    assert key() == first
    photo = folder / "images" / "photo00.png"
    os.utime(photo, ns=(1, 1))
    assert key() not in keys


@pytest.mark.parametrize("left", [200, 0])
def test_a_damaged_file_is_made_again(tmp_path, store, left):
    views = sx.load_dataset(write_capture(tmp_path / "capture", 2)).views
    kept, _ = kept_on_disk(views, store)
    expected = contents(kept)
    for file in store.folder.iterdir():
        file.write_bytes(file.read_bytes()[:left])
    assert contents(kept) == expected
    assert contents(kept) == expected


def test_photos_beyond_the_limit_are_decoded_each_time(tmp_path):
    views = sx.load_dataset(write_capture(tmp_path / "capture", 5)).views
    store = PhotoStore(tmp_path / "store", 2 * (4 * 64 * 48 + photo_store.HEADER))
    kept, use = kept_on_disk(views, store)
    assert use.kept == 2
    assert contents(kept) == contents(views)
    assert len(list(store.folder.iterdir())) == 2
    assert 0 < store.size() <= store.most


def test_what_was_used_longest_ago_makes_room_for_another_capture(tmp_path):
    store = PhotoStore(tmp_path / "store", 3 * (4 * 64 * 48 + photo_store.HEADER))
    old, new = (sx.load_dataset(write_capture(tmp_path / name, 2)).views for name in ("old", "new"))
    first, _ = kept_on_disk(old, store)
    contents(first)
    for i, view in enumerate(first):
        os.utime(store.folder / f"{view.pixels.key}.npy", (i, i))
    _, use = kept_on_disk(new, store)
    assert use.kept == 2
    names = {path.stem for path in store.folder.iterdir()}
    assert first[0].pixels.key not in names
    assert store.clear() == len(names)
    assert store.size() == 0


def test_a_tenth_of_the_disk_is_left_free(tmp_path, store, monkeypatch):
    views = sx.load_dataset(write_capture(tmp_path / "capture", 2)).views
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**6, 9 * 10**5, 10**5))
    kept, use = kept_on_disk(views, store)
    assert use.kept == 0
    monkeypatch.undo()
    kept, _ = kept_on_disk(views, store)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**6, 9 * 10**5, 10**5))
    with pytest.warns(UserWarning, match="a tenth of the disk is left free"):
        assert contents(kept) == contents(views)
    assert not list(store.folder.iterdir())


def test_files_that_a_killed_process_left_are_removed_once_they_are_old(store):
    store.folder.mkdir()
    for name, age in (("old", 2 * photo_store.ABANDONED), ("new", 0)):
        path = store.folder / f".{name}.npy.1.tmp"
        path.write_bytes(b"")
        os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age))
    store.reserve({})
    assert [path.name for path in store.folder.iterdir()] == [".new.npy.1.tmp"]


def test_views_without_files_stay_as_they_are(store):
    views = sx.demo_dataset(photos=3, width=32, height=24).views
    kept, use = kept_on_disk(views, store)
    assert kept == views
    assert use.kept == 0


def test_work_that_needs_more_than_all_memory_runs_alone():
    allowance = Allowance(10)
    with allowance.taken(100):
        assert allowance.limit == 10
    with allowance.taken(6), allowance.taken(4):
        pass
