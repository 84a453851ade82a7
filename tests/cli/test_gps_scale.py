"""`splatax metres --gps`: the scale of a scene from the GPS positions of its photos."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image, TiffImagePlugin
from scipy.spatial.transform import Rotation

import splatax as sx
from scenes import random_gaussians
from splatax import cli, sensors
from splatax.cameras import look_at
from splatax.dataset import Dataset, PointCloud, Survey, View
from splatax.io.gps import GPS_TABLE
from splatax.math.procrustes import robustly_aligned

METRES_PER_DEGREE = 111_319.49  # of the equator
SCALE = 0.4  # metres of a unit


def degrees_of(angle: float):
    return tuple(
        TiffImagePlugin.IFDRational(round(value * 10**6), 10**6)
        for value in (int(abs(angle)), 0, 3600 * (abs(angle) % 1))
    )


def written(path, east, north, up=None, error=None) -> None:
    """Writes a photo that was taken at a place near the equator, metres from latitude 0 and longitude 20."""
    north, east = north / METRES_PER_DEGREE, 20 + east / METRES_PER_DEGREE
    tags = {1: "N" if north >= 0 else "S", 2: degrees_of(north), 3: "E", 4: degrees_of(east)}
    if up is not None:
        tags |= {5: b"\0" if up >= 0 else b"\1", 6: TiffImagePlugin.IFDRational(round(abs(up) * 1000), 1000)}
    if error is not None:
        tags[31] = TiffImagePlugin.IFDRational(round(1000 * error), 1000)
    image = Image.new("RGB", (32, 24))
    exif = image.getexif()
    exif[GPS_TABLE] = tags
    image.save(path, exif=exif)


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """Returns a function that makes a capture of 24 photos around a house, with errors of their positions."""

    def make(noise=0.0, radius=40.0, heights=True, error=None, wrong=(), count=24):
        rng, views, files = np.random.default_rng(0), [], {}
        turn = Rotation.from_euler("y", 130, degrees=True).as_matrix()  # the scene's north is anywhere
        for i in range(count):
            angle, height = 2 * np.pi * i / count, 2.0 + 3 * (i % 3)
            place = np.array([radius * np.cos(angle), 0.7 * radius * np.sin(angle), height])
            local = turn @ np.array([place[0], -place[2], place[1]]) / SCALE  # y points down
            measured = (
                place + noise * rng.normal(size=3) * [1, 1, 2] + ([500.0, -900.0, 0] if i in wrong else 0)
            )
            name = f"p{i:02}.jpg"
            files[name] = tmp_path / name
            written(files[name], *measured[:2], measured[2] if heights else None, error)
            pose = look_at(*(jnp.asarray(v, jnp.float32) for v in (local, [0, -5, 0], [0, -1, 0])))
            pixels = lambda: np.zeros((24, 32, 3), np.uint8)  # noqa: E731
            views.append(View(name, sx.Camera.simple_pinhole(30.0, pose, 32, 24), pixels))
        none = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)))
        dataset = Dataset(tuple(views), (), none, survey=Survey(files=files))
        monkeypatch.setattr("splatax.cli.metres.load_scene", lambda *_, **__: dataset)
        sx.save(tmp_path / "scene.ply", random_gaussians(n=20))
        return tmp_path

    return make


def measured(folder, *options) -> float:
    arguments = ["metres", folder / "scene.ply", "--gps", "--scene", folder, *options]
    cli.main(list(map(str, arguments)))
    return sensors.metres.metres_of(folder / "scene.ply")


@pytest.mark.parametrize("heights", [True, False], ids=["with altitudes", "without altitudes"])
def test_positions_of_the_photos_give_the_scale(capture, capsys, heights):
    found = measured(capture(heights=heights))
    # Degrees of latitude are 0.7 % shorter than the 111,319 m of longitude at the equator.
    assert_allclose(found, SCALE, rtol=0.01)
    said = " ".join(capsys.readouterr().out.split())
    assert "24 of 24 photos" in said
    assert "expected 5 m" in said
    assert ("without heights" in said) != heights


def test_the_scale_is_as_good_as_its_standard_error_says_and_wrong_positions_do_not_matter(capture, capsys):
    found = measured(capture(noise=2.0, error=3.0, wrong=(3, 11, 12)))
    assert_allclose(found, SCALE, rtol=0.05)  # 3 m / (34 m x root of 21) is 2 %; 0.4 % is the ellipsoid
    said = " ".join(capsys.readouterr().out.split())
    assert "expected 3 m" in said
    assert "3 photos left out" in said
    assert "p03.jpg, p11.jpg, p12.jpg" in said


@pytest.mark.parametrize(
    ("made", "options", "message"),
    [
        ({"radius": 3.0}, (), "too close together"),
        ({"count": 3}, (), "at 3 different places, and 4 are needed"),
        ({"noise": 40.0, "radius": 10.0}, ("--gps-error", "0.01"), "too close together"),
        ({}, ("--gps-error", "0"), "a number of metres above 0"),
    ],
    ids=["small", "few", "contradicting", "no error"],
)
def test_positions_that_do_not_give_a_scale_are_refused(capture, capsys, made, options, message):
    with pytest.raises(SystemExit) as end:
        measured(capture(**made), *options)
    assert end.value.code == 2
    assert message in capsys.readouterr().err
    assert sensors.metres.metres_of(capture(**made) / "scene.ply") is None


def test_a_small_error_that_is_stated_lets_a_small_scene_through(capture):
    assert_allclose(measured(capture(radius=3.0), "--gps-error", "0.03"), SCALE, rtol=0.01)


def test_photos_without_positions_are_refused(capture, capsys):
    folder = capture()
    for path in folder.glob("p*.jpg"):
        Image.new("RGB", (32, 24)).save(path)
    with pytest.raises(SystemExit):
        measured(folder)
    assert "0 of 24 photos have a GPS position in EXIF" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("0,0,0", "0,0,1", "2", "--gps"), "stands instead of A, B"), ((), "two places A and B")],
)
def test_a_distance_and_gps_exclude_each_other_and_one_is_needed(capture, capsys, arguments, message):
    with pytest.raises(SystemExit):
        cli.main(["metres", str(capture() / "scene.ply"), *arguments])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_similarity_is_found_though_two_fifths_of_the_points_are_wrong(dimensions):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, dimensions))
    turn = np.linalg.qr(rng.normal(size=(dimensions, dimensions)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    targets = 2.5 * points @ turn.T + rng.normal(size=dimensions)
    targets[:16] += 30 * rng.normal(size=(16, dimensions))
    alignment, agree = robustly_aligned(points, targets, 0.1)
    assert_allclose(alignment.scale, 2.5, rtol=1e-6)
    assert_allclose(alignment.rotation, turn, atol=1e-6)
    assert agree[16:].all()
