"""Captures in zip files: unpacked unchanged, and refused if they would do harm."""

import os
import zipfile
from pathlib import Path

import pytest
from numpy.testing import assert_array_equal

import splatax as sx
from captures import write_blender, write_capture, write_llff, write_transforms, zipped
from splatax.errors import DatasetError
from splatax.io.datasets import archives


@pytest.mark.parametrize("write", [write_capture, write_transforms, write_blender, write_llff])
def test_a_capture_in_a_zip_is_the_capture(write, tmp_path):
    folder = write(tmp_path / "capture")
    plain, packed = sx.load_dataset(folder), sx.load_dataset(zipped(folder, tmp_path / "capture.zip"))
    assert [view.name for view in packed.views] == [view.name for view in plain.views]
    assert_array_equal(packed.train[0].pixels(), plain.train[0].pixels())


def test_an_archive_is_unpacked_once(tmp_path):
    path = zipped(write_capture(tmp_path / "capture"), tmp_path / "capture.zip")
    assert archives.unpacked(path) == archives.unpacked(path)
    os.utime(path, (1, 1))
    assert archives.unpacked(path).is_dir()


def refuse(path, match):
    before = set(Path(archives.tempfile.gettempdir()).glob("splatax-*"))
    with pytest.raises(DatasetError, match=match) as error:
        sx.load_dataset(path)
    assert str(path) in str(error.value)
    assert set(Path(archives.tempfile.gettempdir()).glob("splatax-*")) <= before


@pytest.mark.parametrize(
    "name", ["../escaped.png", "/escaped.png", "a/../../escaped.png", "..\\escaped.png", "C:/escaped"]
)
def test_files_that_would_land_outside(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "capture.zip", "w") as archive:
        archive.writestr("transforms.json", "{}")
        archive.writestr(name, "x")
    refuse(tmp_path / "capture.zip", "leads out of the capture.s folder")
    assert not list(tmp_path.parent.rglob("escaped*"))


def test_links(tmp_path):
    link = zipfile.ZipInfo("images")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(tmp_path / "capture.zip", "w") as archive:
        archive.writestr(link, "/etc")
    refuse(tmp_path / "capture.zip", "images is a link")


@pytest.fixture
def small_limits(monkeypatch):
    monkeypatch.setattr(archives, "SMALLEST_LIMIT", 1 << 20)


def bomb(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("images/a.png", bytes(20 << 20))
    return path


def test_bombs(tmp_path, small_limits):
    refuse(bomb(tmp_path / "capture.zip"), "unpacks to more than")


def test_bombs_that_announce_less_than_they_hold(tmp_path, small_limits):
    path = bomb(tmp_path / "capture.zip")
    announced, actual = (1000).to_bytes(4, "little"), (20 << 20).to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(actual, announced))
    refuse(path, "unpacks to more than|cannot be|can be unpacked")


def test_more_files_than_any_capture_has(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "MOST_FILES", 3)
    refuse(zipped(write_capture(tmp_path / "capture"), tmp_path / "capture.zip"), "3 files")


@pytest.mark.parametrize("contents", [b"", b"no archive", b"PK\x03\x04" + bytes(40)])
def test_what_is_no_archive(tmp_path, contents):
    (tmp_path / "capture.zip").write_bytes(contents)
    refuse(tmp_path / "capture.zip", "not a zip file that can be unpacked")


def test_a_damaged_archive(tmp_path):
    path = zipped(write_capture(tmp_path / "capture"), tmp_path / "capture.zip")
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2] ^= 255
    path.write_bytes(whole)
    refuse(path, "not a zip file that can be unpacked")


def test_two_files_of_one_name(tmp_path):
    with zipfile.ZipFile(tmp_path / "capture.zip", "w") as archive:
        archive.writestr("a", "x")
        archive.writestr("a/b", "x")
    refuse(tmp_path / "capture.zip", "two of its files have one name")


def test_what_was_looked_for_and_found_in_other_folders(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(
        DatasetError, match=r"COLMAP's .*transforms.json .*poses_bounds.npy.* found notes.txt"
    ):
        sx.load_dataset(tmp_path)
    (tmp_path / "notes.txt").unlink()
    with pytest.raises(DatasetError, match="found an empty folder"):
        sx.load_dataset(tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"x")
    with pytest.raises(DatasetError, match="1 photo without poses: find them with splatax reconstruct"):
        sx.load_dataset(tmp_path)
