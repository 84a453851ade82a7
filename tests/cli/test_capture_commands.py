"""splatax reconstruct and splatax inspect, from the command line."""

import re
import shutil

import numpy as np
import pytest
from PIL import Image
from test_refusals import refused

import corner
from captures import write_capture, zipped
from splatax import cli


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return corner.write_photos(tmp_path_factory.mktemp("corner") / "photos")


@pytest.mark.slow
def test_photos_become_a_capture_that_is_sound_enough_to_train_on(photos, tmp_path, capsys):
    out = tmp_path / "capture"
    Image.new("RGB", corner.SIZE).save(photos / "black.png")
    (photos / "walk.mp4").write_bytes(b"x")
    cli.main(["reconstruct", str(photos), "--out", str(out), "--detail", "normal"])
    printed = capsys.readouterr().out
    assert "8 of 9 photos registered" in printed
    assert "not registered: black.png: too few features" in printed
    assert "not registered: walk.mp4: a video, and those among photos are not read" in printed
    for stage in ("reading", "features", "matches", "poses", "writing"):
        assert f"{stage}: " in printed
    assert "--overwrite" in refused(capsys, "reconstruct", photos, "--out", out)
    cli.main(["reconstruct", str(photos), "--out", str(out), "--detail", "normal", "--overwrite"])
    capsys.readouterr()
    cli.main(["inspect", str(out), "--out", str(tmp_path / "page.html")])
    printed = capsys.readouterr().out
    assert re.search(r"photos +8, of which 8 have a pose", printed)
    assert "Only 8 photos." in printed
    assert "<h1>Capture capture</h1>" in (tmp_path / "page.html").read_text()


def nothing(folder):
    return "no photos in this folder"


def one_photo(folder):
    Image.new("RGB", (40, 30)).save(folder / "a.png")
    return "1 photo to use, but depth needs at least 3"


def damaged_photos(folder):
    for name in "abc":
        (folder / f"{name}.jpg").write_bytes(b"\xff\xd8\xff no photo")
    return "0 photos to use (3 cannot be read, such as a.jpg)"


def no_overlap(folder):
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 255, (60, 80, 3), np.uint8)
        Image.fromarray(noise).resize((400, 300)).save(folder / f"{i}.png")
    return "only 0 of 4 photos fit together"


@pytest.mark.parametrize("make", [nothing, one_photo, damaged_photos, no_overlap])
def test_photos_that_make_no_capture(make, tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    reason = make(tmp_path / "photos")
    error = refused(capsys, "reconstruct", tmp_path / "photos", "--out", tmp_path / "out")
    assert f"{tmp_path / 'photos'}: {reason}" in error
    assert (tmp_path / "out").exists() == (make is no_overlap)  # work is kept if photos were matched


def test_other_refusals(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("x")
    assert "neither a folder of photos nor a video" in refused(
        capsys, "reconstruct", tmp_path / "notes.txt", "--out", tmp_path / "out"
    )
    assert "no such folder or video" in refused(
        capsys, "reconstruct", tmp_path / "no", "--out", tmp_path / "out"
    )
    assert "--frames: at least 3" in refused(
        capsys, "reconstruct", tmp_path, "--out", tmp_path / "out", "--frames", "1"
    )


def test_inspect_judges_photos_that_have_no_poses_yet(photos, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit:
        cli.main(["inspect", str(photos), "--out", str(tmp_path / "page.html")])
    assert exit.value.code == 1
    printed = capsys.readouterr().out
    assert "without poses" in printed
    assert re.search(r"^\d problems?, 1 of them serious$|^\d serious problems?$", printed, re.MULTILINE)
    assert f"splatax reconstruct {photos} --out SCENE" in printed
    assert (tmp_path / "page.html").is_file()


def test_inspect_names_what_it_does_not_look_at(photos, tmp_path, capsys):
    folder = shutil.copytree(photos, tmp_path / "photos")
    for name in ("raw.dng", "walk.mp4"):
        (folder / name).write_bytes(b"x")
    with pytest.raises(SystemExit):
        cli.main(["inspect", str(folder), "--out", str(tmp_path / "page.html")])
    printed = " ".join(capsys.readouterr().out.split())
    assert "1 file cannot be used: raw.dng" in printed
    assert "1 file cannot be used: walk.mp4" in printed
    assert printed.count("splatax reconstruct") == 2
    assert printed.count(f"splatax reconstruct {folder} --out SCENE") == 1
    for photo in [*folder.glob("*.jpg"), *folder.glob("*.png")]:
        photo.unlink()
    assert "1 photo in formats that splatax does not know: raw.dng" in refused(capsys, "inspect", folder)
    (folder / "raw.dng").unlink()
    assert f"Give the video itself, such as {folder / 'walk.mp4'}" in refused(capsys, "inspect", folder)


@pytest.mark.parametrize("command", ["inspect", "train"])
def test_a_video_given_as_a_capture_is_told_how_to_become_one(tmp_path, capsys, command):
    (tmp_path / "walk.mp4").write_bytes(b"x")
    error = refused(capsys, command, tmp_path / "walk.mp4", "--out", tmp_path / "out")
    assert "walk.mp4: a video, not a capture. Make a capture of it with splatax reconstruct" in error


def test_inspect_of_a_zip_with_brackets_in_a_name(tmp_path, capsys):
    capture = write_capture(tmp_path / "a[red]b")
    cli.main(
        ["inspect", str(zipped(capture, tmp_path / "a[red]b.zip")), "--out", str(tmp_path / "page.html")]
    )
    assert "9, of which 9 have a pose" in capsys.readouterr().out


def test_inspect_refuses_what_is_no_capture(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert "It looked for COLMAP's" in refused(capsys, "inspect", tmp_path / "empty")
    assert "no such folder" in refused(capsys, "inspect", tmp_path / "none")
