"""Whole commands `splatax create`, from drawn photos, panoramas and a drawn video to the page."""

import json

import numpy as np
import pytest
from PIL import Image

import corner
import papered_room
import splatax as sx
from splatax import cli
from splatax.dataset import photos_in
from splatax.io import video
from splatax.reconstruction import pipeline
from splatax.web import page

STOPS = np.array([0.5, -0.4, 0.1, -0.6, 0.6, 0.3, -0.5, 0.0, 0.4, -0.3, -0.1, 0.2])  # of the photos' exposure
GAMMA = 2.2  # of the camera
QUICK = ("--steps", "240", "--downscale", "2")


@pytest.fixture(autouse=True)
def quick(tmp_path, monkeypatch):
    """Normal features, which are enough for the corner, and a viewer that is none where none is built."""
    monkeypatch.setattr(pipeline, "VERY_FEW", 0)
    if not page.VIEWER.exists():
        (tmp_path / "viewer.js").write_text("")
        monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")


def exposed(photo, stops):
    """A photo as another exposure would have made it, clipped where it is too bright."""
    light = (photo / 255) ** GAMMA * 2**stops
    return np.round(255 * np.clip(light, 0, 1) ** (1 / GAMMA)).astype(np.uint8)


def drawn(count):
    """Photos of a papered corner, from left to right."""
    paper = corner.wallpaper()
    return [corner.photograph(position, paper) for position in corner.positions(count)]


def created(source, out):
    """The metrics of the two runs that the command makes, and the opening of the report."""
    cli.main(["create", str(source), "--out", str(out), *QUICK])
    trial, run = (json.loads((out / name / "metrics.json").read_text()) for name in ("trial", "run"))
    report = (out / "run" / "report.html").read_text()
    return trial, run, report[: report.index("<h2>Numbers</h2>")]


@pytest.mark.slow
def test_twelve_photos_of_uneven_exposure_become_a_page(tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "my room"
    photos.mkdir()
    for i, photo in enumerate(drawn(len(STOPS))):
        Image.fromarray(exposed(photo, STOPS[i])).save(photos / f"IMG_{1201 + i}.jpg", quality=95)
    trial, run, opening = created(photos, out)
    told = capsys.readouterr().out
    assert "exposure differs between photos" in told
    assert "loses: " in told
    assert len(sx.load_dataset(out / "capture").views) == len(STOPS)
    assert run["judged_by"]["test"] == trial["test"]
    assert "The exposure of the photos differs." in opening
    assert "There are only 12 photos." in opening
    assert "the scene of the trial run from there" in opening
    assert (out / "scene.html").exists()


@pytest.mark.slow
def test_a_video_becomes_a_page(tmp_path):
    pytest.importorskip("av", reason="no PyAV: pip install '.[video]'")
    with video.writing(tmp_path / "walk.mp4", corner.SIZE, fps=10) as add:
        for photo in drawn(20):
            add(photo.astype(np.uint8))
    trial, run, opening = created(tmp_path / "walk.mp4", tmp_path / "my room")
    assert len(sx.load_dataset(tmp_path / "my room" / "capture").views) == 20
    assert run["judged_by"]["test"] == trial["test"]
    assert "The exposure of the photos differs." not in opening
    assert (tmp_path / "my room" / "scene.html").exists()


@pytest.mark.slow
def test_panoramas_become_a_page(tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "my room"
    photos.mkdir()
    papered_room.write(photos)
    cli.main(["create", str(photos), "--out", str(out), *QUICK])
    told = capsys.readouterr().out
    assert "6 photos of 360 degrees, in 36 faces" in told
    assert told.count("warning: Only 6 photos.") == 1
    assert photos_in(sx.load_dataset(out / "capture").views) == papered_room.COUNT
    assert (out / "scene.html").exists()
