"""`splatax metres` and `splatax label`: the scale of a scene, and its parts from label images."""

import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import splatax as sx
from scenes import camera_at, plane_of_gaussians, random_gaussians
from splatax import cli, sensors
from splatax.dataset import Dataset, PointCloud, View
from splatax.errors import FormatError
from splatax.io import formats, label_images

PLANE = plane_of_gaussians(np.array([0.0, 0.0, -1.0]), n=500, half=1.5, sigma=0.08)


@pytest.fixture
def scene(tmp_path):
    sx.save(tmp_path / "scene.ply", random_gaussians(n=20), comments=("kept",))
    return tmp_path / "scene.ply"


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """Three photos of a plane, with label images: 1 left of x = 0, 2 right of it. The last is held out."""
    views, masks = [], tmp_path / "labels"
    masks.mkdir()
    for i, x in enumerate((0.3, -0.5, 0.1)):
        camera = camera_at((x, 0.2, -3.0), size=(32, 24))
        points = sensors.observe(PLANE, camera, {"p": sensors.PointCloud(frame="world")})["p"]
        labels = np.where(np.isnan(points[..., 0]), 0, np.where(points[..., 0] > 0, 2, 1))
        Image.fromarray(labels.astype(np.uint8)).save(masks / f"p{i}.png")
        views.append(View(f"p{i}.jpg", camera, lambda: np.zeros((24, 32, 3), np.uint8)))
    nothing = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)))
    dataset = Dataset(tuple(views[:2]), (views[2],), nothing)
    for command in ("label", "metres"):
        monkeypatch.setattr(f"splatax.cli.{command}.load_scene", lambda *_, **__: dataset)
    sx.save(tmp_path / "plane.ply", PLANE)
    return tmp_path


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        cli.main(list(map(str, arguments)))
    assert end.value.code == 2
    return capsys.readouterr().err


def test_a_known_distance_gives_the_scene_its_scale_and_changes_no_gaussian(scene, capsys):
    before = sx.load(scene)
    cli.main(["metres", str(scene), "0,0,1", "(0,3,-3)", "2.5"])
    told = capsys.readouterr().out
    assert "5 units are 2.5 m, so one unit is 0.5 m" in told
    assert "loses: nothing" in told
    assert_array_equal(sx.load(scene).means, before.means)
    assert "kept" in formats.comments(scene)
    scaled = sensors.load_in_metres(scene)
    assert_allclose(scaled.means, 0.5 * before.means, rtol=1e-6)
    assert_allclose(scaled.scales, 0.5 * before.scales, rtol=1e-5)


def test_a_second_measurement_replaces_the_first(scene):
    for length in ("2.5", "10"):
        cli.main(["metres", str(scene), "(-5,0,0)", "0,0,0", length])
    assert [line for line in formats.comments(scene) if "etre" in line] == ["Metres per unit: 2.0"]


def test_photos_that_are_a_known_distance_apart_give_the_scale_of_a_copy(capture):
    arguments = ["metres", capture / "plane.ply", "p0.jpg", "p1.jpg", "1.6", "--scene", capture]
    cli.main([*map(str, arguments), "--out", str(capture / "copy.ply")])
    scaled = sensors.load_in_metres(capture / "copy.ply")
    assert_allclose(scaled.means, 2 * PLANE.means, rtol=1e-5)
    with pytest.raises(FormatError, match=r"plane.ply: keeps no scale"):
        sensors.load_in_metres(capture / "plane.ply")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("0,0,1", "0,0,1", "2"), "in the same place"),
        (("0,0,1", "0,0,2", "0"), "more than 0"),
        (("0,0,1", "door.jpg", "2"), "for photos the capture is needed"),
        (("0,0,1", "0,0,2", "2", "--out", "copy.spz"), "only .ply files keep a scale without loss"),
    ],
)
def test_distances_that_say_nothing_are_refused(scene, capsys, arguments, message):
    assert message in refused(capsys, "metres", scene, *arguments)


def test_a_damaged_scale_is_refused_with_the_file(scene):
    sx.save(scene, sx.load(scene), comments=("Metres per unit: -1",))
    with pytest.raises(FormatError, match=r"scene\.ply"):
        sensors.load_in_metres(scene)


@pytest.mark.slow
def test_label_images_split_a_scene_into_named_parts_and_held_out_ones_measure_it(capture, capsys):
    (capture / "labels" / "labels.txt").write_text("nothing\nleft\nright\n")
    (capture / "labels" / "slip.png").write_bytes(b"of no photo")
    out = capture / "parts.glb"
    arguments = [
        "label",
        capture / "plane.ply",
        "--masks",
        capture / "labels",
        "--scene",
        capture,
        "--out",
        out,
    ]
    cli.main(list(map(str, arguments)))
    said = capsys.readouterr().out
    assert "parts from 2 label images" in said
    assert "1 label image in" in said
    assert "no photo has the name: slip.png" in said
    assert float(said.split("1 held-out photo: ")[1].split()[0]) > 0.9
    parts = sx.load_scene(out)
    assert {"left", "right"} <= set(parts.names)
    assert len(parts) == len(PLANE)
    assert np.mean(np.asarray(parts["left"].gaussians.means)[:, 0] < 0.1) > 0.98


def test_label_images_are_read_as_numbers_at_the_size_of_the_view(tmp_path):
    labels = np.array([[0, 1], [255, 3]], np.uint8)
    picture = Image.fromarray(labels)
    picture.save(tmp_path / "grey.png")
    coloured = Image.fromarray(labels, "P")
    coloured.putpalette([7 * i % 256 for i in range(768)])
    coloured.save(tmp_path / "palette.png")
    for name in ("grey.png", "palette.png"):
        assert_array_equal(label_images.read(tmp_path / name, 2, 2), [[0, 1], [-1, 3]])
    assert_array_equal(label_images.read(tmp_path / "grey.png", 4, 4)[::3, ::3], [[0, 1], [-1, 3]])


def test_label_images_that_do_not_fit_are_refused(capture, capsys):
    def run(**changed):
        given = {"masks": capture / "labels", "scene": capture, "out": capture / "parts.glb"} | changed
        options = [text for name, value in given.items() for text in (f"--{name}", value)]
        return refused(capsys, "label", capture / "plane.ply", *options)

    assert "in .glb files" in run(out=capture / "parts.ply")
    (capture / "empty").mkdir()
    assert "no label image of a training photo" in run(masks=capture / "empty")
    (capture / "labels" / "labels.txt").write_text("nothing\nleft\n")
    assert "2 names, but the label images have labels up to 2" in run()
    Image.new("RGB", (32, 24)).save(capture / "labels" / "p0.png")
    assert "a picture of colours (RGB)" in run()
    Image.new("L", (32, 20)).save(capture / "labels" / "p0.png")
    assert "other proportions" in run()


def test_label_images_in_the_folder_of_the_captures_own_masks_are_refused(capture, capsys):
    shutil.copytree(capture / "labels", capture / "masks")
    said = refused(capsys, "label", capture / "plane.ply", "--masks", capture / "masks", "--scene", capture)
    assert "the capture keeps masks there" in said


def test_parts_and_exported_copies_keep_the_scale_in_metres(scene, capture, tmp_path, capsys):
    cli.main(["metres", str(scene), "0,0,0", "0,0,1", "0.5"])
    for suffix in (".ply", ".glb", ".sog"):
        cli.main(["export", str(scene), str(tmp_path / f"twice{suffix}"), "--scale", "2"])
        assert sensors.metres.metres_of(tmp_path / f"twice{suffix}") == 0.25
    cli.main(["export", str(scene), str(tmp_path / "a.splat")])
    assert ".splat files do not keep the scale in metres" in capsys.readouterr().out
    cli.main(["metres", str(capture / "plane.ply"), "0,0,0", "0,0,1", "0.5"])
    cli.main(
        ["label", str(capture / "plane.ply"), "--masks", str(capture / "labels"), "--scene", str(capture)]
    )
    assert sensors.metres.metres_of(capture / "parts.glb") == 0.5


def test_label_numbers_with_gaps_are_refused_before_memory_runs_out(capture, capsys, monkeypatch):
    monkeypatch.setattr("splatax.cli.label.machine_memory", lambda: 1 << 30)
    picture = np.asarray(Image.open(capture / "labels" / "p0.png")).astype(np.uint16)
    picture[0, 0] = 60_000
    Image.fromarray(picture).save(capture / "labels" / "p0.png")
    said = refused(capsys, "label", capture / "plane.ply", "--masks", capture / "labels", "--scene", capture)
    assert "60,001 labels" in said
    assert "without gaps" in said
