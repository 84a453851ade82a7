"""`splatax render --path`: videos with the requested contents, and refusals."""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from test_refusals import refused

import splatax as sx
from splatax import cli, trajectories
from splatax.io import video
from splatax.metrics import to_8bit

CAPTURE_SIZE = (64, 48)


def film(scene, out, *options):
    """Writes a video. The scene is a model, which may be followed by its capture."""
    cli.main(
        [
            "render",
            *(str(path) for path in scene),
            "--path",
            "interpolate",
            "--fps",
            "4",
            "--seconds",
            "1",
            "--out",
            str(out),
            *options,
        ]
    )
    return out


def test_a_folder_of_frames_shows_what_the_cameras_of_the_path_see(trained, capture, tmp_path):
    out = film((trained,), tmp_path / "frames")
    assert [path.name for path in sorted(out.iterdir())] == [f"frame{i:05}.png" for i in range(4)]
    cameras = [view.camera for view in sx.load_dataset(capture).views]
    expected = [
        to_8bit(np.asarray(sx.render(sx.load(trained / "scene.ply"), camera).rgb))
        for camera in trajectories.tour(cameras, 4, CAPTURE_SIZE)
    ]
    for i, picture in enumerate(expected):
        assert_array_equal(np.asarray(Image.open(out / f"frame{i:05}.png")), picture)


def test_a_gif_lasts_as_long_as_asked(trained, tmp_path):
    with Image.open(film((trained,), tmp_path / "film.gif", "--size", "33x21")) as picture:
        assert picture.size == (33, 21)
        durations = []
        for i in range(picture.n_frames):
            picture.seek(i)
            durations.append(picture.info["duration"])
    assert sum(durations) == 1000


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "h264"), (".webm", "vp9")])
def test_a_film_has_its_size_its_frames_and_its_colours(suffix, codec, tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / f"film{suffix}"
    color = np.array([200, 90, 40], np.uint8)
    with video.writing(path, (64, 48), 10) as add:
        for _ in range(7):
            add(np.broadcast_to(color, (48, 64, 3)))
    with av.open(path) as film:
        stream = film.streams.video[0]
        assert stream.codec_context.name in (codec, f"lib{codec}", "libvpx-vp9")
        assert stream.average_rate == 10
        frames = [frame.to_ndarray(format="rgb24", src_colorspace="ITU709") for frame in film.decode(video=0)]
    assert len(frames) == 7
    assert frames[3].shape == (48, 64, 3)
    assert np.abs(frames[3].astype(int) - color).max() <= 4  # limited range and 4:2:0 round


def test_depth_stands_beside_colour_in_colours_that_stay_and_normals_beside_it(wall, tmp_path, capsys):
    plain = film(wall, tmp_path / "plain")
    assert "depth   " not in capsys.readouterr().out
    wide = film(wall, tmp_path / "wide", "--depth", "surface_depth", "--normals")
    assert "depth   surface_depth\n" in capsys.readouterr().out
    for path in sorted(plain.iterdir()):
        colour, frame = np.asarray(Image.open(path)), np.asarray(Image.open(wide / path.name))
        assert frame.shape == (48, 192, 3)
        assert_array_equal(frame[:, :64], colour)
        assert frame[:, 64:128].any()
        facing = frame[:, 128:].astype(int) - [128, 128, 255]  # the cameras turn by at most 0.2 radians
        assert np.abs(facing).max() <= 0.2 * 128 + 1  # levels are rounded


def test_keyframes_and_orbits_need_no_capture(trained, tmp_path, capsys):
    sx.save(tmp_path / "scene.ply", sx.load(trained / "scene.ply"))
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"keyframes": [{"position": [0, 0, -4], "wxyz": [1, 0, 0, 0], "fov": 50}]}))
    for shape in ("orbit", str(path)):
        options = f"--path {shape} --size 40x30 --fps 2 --seconds 1 --depth auto --overwrite --out".split()
        cli.main(["render", str(tmp_path / "scene.ply"), *options, str(tmp_path / "frames")])
        assert Image.open(tmp_path / "frames" / "frame00001.png").size == (80, 30)
        assert "median_surface_depth: the default, because there is no capture" in capsys.readouterr().out


def test_a_film_is_not_replaced_unless_told(trained, tmp_path, capsys):
    for out in (tmp_path / "frames", tmp_path / "film.gif"):
        film((trained,), out)
        assert "--overwrite" in refused(capsys, "render", trained, "--path", "interpolate", "--out", out)
        film((trained,), out, "--overwrite")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--path interpolate --size wide --out film.gif", "--size"),
        ("--path interpolate --fps 0 --out film.gif", "--fps"),
        ("--path interpolate --seconds -1 --out film.gif", "--seconds"),
        ("--path interpolate --out film.avi", ".mp4, .webm or .gif"),
        ("--path missing.json --out film.gif", "missing.json"),
        ("--fps 10 --out frames", "--path orbit"),
        ("--out film.mp4", "--path orbit"),
    ],
)
def test_options_that_make_no_film(trained, tmp_path, monkeypatch, capsys, options, named):
    monkeypatch.chdir(tmp_path)
    assert named in refused(capsys, "render", trained, *options.split())
    assert list(tmp_path.iterdir()) == []


def test_odd_numbers_of_pixels_and_no_encoder_are_refused(monkeypatch, tmp_path, capsys, trained):
    arguments = ("render", trained, "--path", "interpolate", "--out", tmp_path / "film.mp4")
    pytest.importorskip("av")
    assert "even" in refused(capsys, *arguments, "--size", "33x20")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    assert "pip install '.[video]' in the checkout" in refused(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []
