"""The demo: a capture like a real one, and a scene that tests the whole pipeline."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from splatax.demo.capture import write_capture
from splatax.demo.raycast import look, truth
from splatax.demo.scenes.still_life import STILL_LIFE


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    write_capture(folder)
    return folder


@pytest.mark.slow
def test_the_capture_loads_as_any_other(capture):
    dataset = sx.load_dataset(capture)
    assert "24 of 24 photos registered" in dataset.notes
    assert [view.name for view in dataset.test] == ["view00.png", "view08.png", "view16.png"]
    assert "median reprojection error 0.00 px" in " ".join(dataset.notes)
    assert dataset.views[0].pixels().shape == (120, 160, 3)


@pytest.mark.slow
def test_points_have_the_colours_that_photos_show_there(capture):
    dataset = sx.load_dataset(capture)
    view = dataset.train[3]
    pixels = view.pixels()
    camera, photo = view.camera, pixels
    local = np.asarray(dataset.points.positions) @ np.asarray(camera.rotation).T + np.asarray(
        camera.translation
    )
    x = (local[:, 0] / local[:, 2] * float(camera.fx) + float(camera.cx)).astype(int)
    y = (local[:, 1] / local[:, 2] * float(camera.fy) + float(camera.cy)).astype(int)
    inside = (local[:, 2] > 0) & (x >= 0) & (x < 160) & (y >= 0) & (y < 120)
    difference = np.abs(photo[y[inside], x[inside]] / 255 - dataset.points.colors[inside]).mean(axis=1)
    # Hidden points, highlights and edges differ; surfaces that are seen do not.
    assert np.median(difference) < 0.03


@pytest.mark.slow
def test_the_data_set_in_memory_is_the_capture_on_disk(capture):
    in_memory, on_disk = sx.demo_dataset(), sx.load_dataset(capture)
    assert [view.name for view in in_memory.test] == [view.name for view in on_disk.test]
    view, same = in_memory.views[5], on_disk.views[5]
    assert_array_equal(view.pixels(), same.pixels())
    assert_allclose(view.camera.cam_from_world, same.camera.cam_from_world, atol=1e-6)  # through a quaternion
    assert_array_equal(*(sorted(map(tuple, each.points.positions)) for each in (in_memory, on_disk)))


@pytest.mark.parametrize("photos", [1, 7, 35])
def test_no_two_cameras_of_a_data_set_stand_in_one_place(photos):
    positions = np.stack([np.asarray(camera.position) for camera in STILL_LIFE.cameras(photos)])
    assert len(np.unique(positions.round(4), axis=0)) == photos


def test_photos_of_another_size_show_the_same_width_of_the_scene():
    (full,), (half,) = STILL_LIFE.cameras(1), STILL_LIFE.cameras(1, (80, 60))
    assert float(half.fx) == pytest.approx(float(full.fx) / 2)
    assert (half.width, half.height) == (80, 60)


def test_a_data_set_without_photos_is_refused():
    with pytest.raises(ValueError, match="not 0 of 160 x 120 pixels"):
        sx.demo_dataset(photos=0)


def test_the_highlight_moves_with_the_view():
    views = STILL_LIFE.cameras()[:8]
    sharpest = []
    for camera in views:
        x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
        seen = look(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32), STILL_LIFE)
        on_ball = np.linalg.norm(np.asarray(seen.point) - [-0.15, -0.1, 0.36], axis=1) < 0.361
        green = np.where(on_ball, np.asarray(seen.color)[:, 1], -1)  # the ball is red, its highlight white
        sharpest.append(np.asarray(seen.point)[green.argmax()])
    distances = np.linalg.norm(np.diff(sharpest, axis=0), axis=1)
    assert distances.max() > 0.1


@pytest.mark.slow
def test_the_demo_reaches_35_db_on_views_it_has_not_seen(tmp_path):
    """As a user runs it. An honest run gives 36.6 dB; the rest is for other machines' rounding."""
    command = [
        sys.executable,
        "-c",
        "from splatax.cli import main; main()",
        "demo",
        "--out",
        str(tmp_path / "run"),
    ]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # that of the tests, which would take its place
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["test"]["psnr"] >= 35
    assert metrics["gaussians"] > 3_000  # density control has added some
    assert str(tmp_path / "run" / "report.html") in done.stdout
    assert any((tmp_path / "cache" / "splatax" / "xla").iterdir())  # compiled programs are kept


@pytest.mark.slow
def test_the_truth_on_disk_is_that_of_the_ray_caster(capture):
    view, camera = sx.load_dataset(capture).views[3], STILL_LIFE.cameras()[3]
    on_disk, exact = view.truth(), truth(camera, STILL_LIFE)
    known = np.isfinite(exact.depth)
    assert_allclose(on_disk.depth, np.where(known, exact.depth, 0), rtol=1e-4)
    cosines = np.sum(on_disk.normals * np.asarray(exact.normals), axis=2)
    assert np.degrees(np.arccos(np.clip(cosines[known], -1, 1))).max() < 0.2
    in_memory = sx.demo_dataset().views[3].truth()
    assert_allclose(in_memory.depth, on_disk.depth, rtol=1e-4)
