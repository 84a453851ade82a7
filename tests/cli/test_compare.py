"""`splatax compare`: runs side by side, and refusals of runs that cannot be compared."""

import json
import re
import shutil
from base64 import b64decode
from dataclasses import replace
from io import BytesIO

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from test_refusals import refused

import splatax as sx
from captures import write_capture
from splatax import cli
from splatax.io.datasets import colmap_writing
from splatax.reconstruction.panoramas import FACES
from splatax.report.side_by_side import Curve, Lineup, Row, joined, most_different, side_by_side
from splatax.splits import Nothing


@pytest.fixture
def runs(trained, tmp_path):
    """Two runs: the trained one, and a copy with another name and another seed."""
    copies = [tmp_path / "runs" / name for name in ("first", "second")]
    for copy in copies:
        shutil.copytree(trained, copy)
    change(copies[1] / "config.json", lambda config: config["options"].update(seed=7))
    return copies


def change(path, edit):
    contents = json.loads(path.read_text())
    edit(contents)
    path.write_text(json.dumps(contents))


def test_a_table_and_a_page_show_all_runs(runs, tmp_path, capsys):
    change(runs[1] / "metrics.json", lambda metrics: metrics["test"].update(psnr=99.0))
    cli.main(["compare", *map(str, runs)])
    printed = capsys.readouterr().out
    assert re.search(r"test PSNR, dB +│ +\d+\.\d{3} │ +99\.000", printed)
    assert re.search(r"--seed +│ +0 │ +7", printed)
    assert "--steps" not in printed  # the same in both, and a row of its own
    page = (runs[0].parent / "compare" / "compare.html").read_text()
    assert "<b>99.000</b>" in page
    assert page.count("<header>") == 1  # test photo
    assert page.count('src="data:image/jpeg') == 2 * 3
    assert set(re.findall(r'src="(.{5})', page)) == {"data:"}


def test_all_faces_of_a_panorama_are_in_its_picture(runs, tmp_path):
    capture = in_faces(write_capture(tmp_path / "faces", count=6))
    for run, psnr in zip(runs, (20.0, 30.0), strict=True):
        change(run / "config.json", lambda config: config["options"].update(scene=str(capture)))
        views = [{"name": "photo0", "psnr": psnr, "ssim": 0.5, "corrected_psnr": psnr}]
        change(run / "metrics.json", lambda metrics, views=views: metrics["test"].update(views=views))
    cli.main(["compare", *map(str, runs)])
    page = (runs[0].parent / "compare" / "compare.html").read_text()
    assert "<b>photo0</b>" in page
    shown = re.findall(r'src="data:image/jpeg;base64,([^"]+)" alt="(?:photo|first|second)"', page)
    sizes = [Image.open(BytesIO(b64decode(picture))).size for picture in shown]
    assert sizes == [(3 * 64, 2 * 48)] * 3


def in_faces(capture):
    """Makes the photos of a capture the faces of one panorama, and returns its folder."""
    dataset = sx.load_dataset(capture, hold_out=Nothing())
    views = [
        replace(view, face_of="photo0", camera=replace(view.camera, cam_from_world=turn))
        for view, turn in zip(dataset.train, turns(), strict=True)
    ]
    colmap_writing.save(capture, views, dataset.points)
    return capture


def turns():
    for face in FACES:
        yield jnp.eye(4).at[:3, :3].set(jnp.array(face.rotation, jnp.float32))


def test_faces_are_joined_in_rows_and_a_single_picture_stays_as_it_is():
    faces = [np.full((4, 5, 3), value, np.uint8) for value in range(1, 5)]
    assert joined(faces[:1]) is faces[0]
    whole = joined(faces)
    assert whole.shape == (8, 15, 3)
    assert [whole[row, column, 0] for row, column in ((0, 0), (3, 5), (0, 14), (4, 0), (4, 5))] == [
        1,
        2,
        3,
        4,
        0,
    ]


def test_runs_from_before_a_measure_existed_have_it_unknown(runs, tmp_path, capsys):
    change(runs[0] / "metrics.json", lambda metrics: metrics["test"].pop("corrected_psnr"))
    cli.main(["compare", *map(str, runs), "--out", str(tmp_path / "out")])
    assert re.search(r"corrected PSNR, dB +│ +- │ +\d", capsys.readouterr().out)
    assert (tmp_path / "out" / "compare.html").exists()


def of_another_capture(runs, tmp_path):
    other = write_capture(tmp_path / "other")
    change(runs[1] / "config.json", lambda config: config["options"].update(scene=str(other)))
    return f"{runs[1]}: trained on {other}, but"


def of_another_split(runs, tmp_path):
    change(runs[1] / "metrics.json", lambda metrics: metrics["test"]["views"].pop())
    return f"{runs[0]}: tested on photo04.png, which {runs[1]} is not"


def of_another_protocol(runs, tmp_path):
    change(runs[1] / "metrics.json", lambda metrics: metrics["protocol"].update(ssim="7x7 windows"))
    return f"{runs[1]}: measured differently from {runs[0]}: ssim is '7x7 windows', there"


def with_masks(runs, tmp_path):
    change(runs[1] / "metrics.json", lambda metrics: metrics.update(masked_test_views=2))
    return f"{runs[1]}: measured differently from {runs[0]}: number of masks is 2, there 0"


def of_another_size(runs, tmp_path):
    change(runs[1] / "config.json", lambda config: config["options"].update(downscale=2))
    return f"{runs[1]}: measured on photos of 32 x 24 pixels, but {runs[0]} on 64 x 48"


def whose_capture_is_gone(runs, tmp_path):
    for run in runs:
        change(run / "config.json", lambda config: config["options"].update(scene=str(tmp_path / "gone")))
    return f"{runs[0]}: its capture is no longer at {tmp_path / 'gone'}. Say where it is: --scene"


def without_test_photos(runs, tmp_path):
    change(runs[1] / "metrics.json", lambda metrics: metrics.update(test=None))
    return f"{runs[1]}: a run without test photos"


def not_finished(runs, tmp_path):
    (runs[1] / "metrics.json").unlink()
    return f"{runs[1]}: no metrics.json in it"


def with_a_damaged_file(runs, tmp_path):
    (runs[1] / "metrics.json").write_text("{")
    return f"{runs[1] / 'metrics.json'}: damaged"


def with_a_measure_missing(runs, tmp_path):
    change(runs[1] / "metrics.json", lambda metrics: metrics.pop("gaussians"))
    return f"{runs[1] / 'metrics.json'}: damaged (no 'gaussians' in it)"


@pytest.mark.parametrize(
    "differ",
    [
        of_another_capture,
        of_another_split,
        of_another_protocol,
        with_masks,
        of_another_size,
        whose_capture_is_gone,
        without_test_photos,
        not_finished,
        with_a_damaged_file,
        with_a_measure_missing,
    ],
)
def test_runs_that_cannot_be_compared_are_refused(runs, tmp_path, capsys, differ):
    expected = differ(runs, tmp_path)
    assert expected in refused(capsys, "compare", *runs)
    assert not (runs[0].parent / "compare").exists()


def test_one_run_or_the_same_twice_is_refused(runs, capsys):
    assert "two runs or more" in refused(capsys, "compare", runs[0])
    assert f"{runs[0]}: given twice" in refused(capsys, "compare", runs[0], runs[0])


def test_a_capture_that_has_moved_is_found_where_it_is_said_to_be(runs, capture, tmp_path):
    whose_capture_is_gone(runs, tmp_path)
    cli.main(["compare", *map(str, runs), "--scene", str(capture)])
    assert (runs[0].parent / "compare" / "compare.html").exists()


def test_the_crop_is_where_the_runs_differ_most():
    images = [np.full((50, 80, 3), 100, np.uint8) for _ in range(2)]
    images[1][30:40, 60:70] = 200
    assert most_different(images) == (60, 30, 70, 40)
    images[1][0:10, 0:10] = 255
    assert most_different(images) == (0, 0, 10, 10)
    mask = np.ones((50, 80), bool)
    mask[:20] = False
    assert most_different(images, mask) == (60, 30, 70, 40)
    left, top, right, bottom = most_different(images[:1] * 2)  # nowhere: any will do that lies inside
    assert 0 <= left < right <= 80
    assert 0 <= top < bottom <= 50


def test_names_are_escaped_and_views_that_differ_most_come_first():
    picture = np.zeros((20, 30, 3), np.uint8)
    names = ("<script>$a$", "b & c")
    psnrs = {"same": (20.0, 20.0), "<i>": (10.0, 30.0)}
    curves = [Curve((1.0, 2.0), (10.0, 12.0)), Curve((), ())]
    page = side_by_side(
        names,
        [Row("x", ("<b>", "2"), (False, True))],
        curves,
        psnrs,
        lambda name: Lineup(name, picture, (picture, picture), psnrs[name]),
    )
    assert "<script>" not in page
    assert "<i>" not in page
    assert "&lt;script&gt;$a$" in page
    assert "<td>&lt;b&gt;</td><td><b>2</b></td>" in page
    assert page.index("&lt;i&gt;") < page.index("same")


def test_only_the_views_that_differ_most_are_drawn_and_all_are_listed(monkeypatch):
    monkeypatch.setattr("splatax.report.side_by_side.MOST", 3)
    picture, drawn = np.zeros((20, 30, 3), np.uint8), []

    def lineup(name):
        drawn.append(name)
        return Lineup(name, picture, (picture, picture), psnrs[name])

    psnrs = {f"view{i}": (20.0, 20.0 + i) for i in range(9)}
    page = side_by_side(("a", "b"), [], [Curve((), ()), Curve((), ())], psnrs, lineup)
    assert drawn == ["view8", "view7", "view6"]
    assert page.count("<figcaption>photo</figcaption>") == 3
    assert all(f"<td>{name}</td>" in page for name in psnrs)


def test_pictures_in_the_page_are_those_of_the_runs(runs):
    """The crop shows pixels as squares, none of them smoothed."""
    from splatax.report.side_by_side import enlarged

    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    crop = enlarged(picture, (5, 6, 9, 10))
    assert crop.shape == (360, 360, 3)
    assert_array_equal(crop[45::90, 45::90], picture[6:10, 5:9])
