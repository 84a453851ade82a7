"""Files that are written whole or not at all."""

import errno
import os
import re

import pytest

from splatax.errors import InputError
from splatax.io.files import disk_of, path_inside, replacing, write_whole


def stop(file):
    file.write(b"half")
    raise RuntimeError("stop")


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "scene.ply"
    write_whole(path, b"old")
    with pytest.raises(RuntimeError, match="stop"), replacing(path) as file:
        stop(file)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("parent", ["nowhere", "file"])
def test_what_cannot_be_written_is_named_as_the_caller_named_it(tmp_path, parent):
    (tmp_path / "file").touch()
    path = tmp_path / parent / "scene.ply"
    with pytest.raises(OSError, match="scene") as refused:
        write_whole(path, b"")
    assert refused.value.filename == str(path)


def test_a_failed_write_names_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as the system does: without a name

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as refused:
        write_whole(tmp_path / "scene.ply", b"")
    assert refused.value.filename == str(tmp_path / "scene.ply")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.png", "left/a.png", "a..b/..c.png", "./a.png"])
def test_names_of_views_lie_inside_their_folder(name, tmp_path):
    assert path_inside(tmp_path / "out", name) == tmp_path / "out" / name


@pytest.mark.parametrize("name", ["../a.png", "left/../../a.png", "/a.png", "..", ".", "", "a\0.png"])
def test_names_that_lead_out_of_the_folder_are_refused(name, tmp_path):
    with pytest.raises(InputError, match="outside"):
        path_inside(tmp_path / "out", name)


def test_links_that_lead_out_of_the_folder_are_refused(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "link").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(InputError, match="symbolic link"):
        path_inside(tmp_path / "out", "link/a.png")


def test_a_disk_is_known_by_its_mount_point_and_free_bytes(tmp_path):
    words = re.fullmatch(r"the disk at (.+), ([\d,]+) bytes free", disk_of(tmp_path / "no" / "such" / "file"))
    assert os.path.ismount(words[1])
    assert tmp_path.is_relative_to(words[1])
