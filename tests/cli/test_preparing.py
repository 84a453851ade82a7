"""Decisions of training about a capture, and captures without points."""

import json
from dataclasses import replace

import jax
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_array_equal
from test_refusals import refused

import splatax as sx
from captures import POINTS, write_blender, write_capture, write_llff, write_transforms
from splatax import cli
from splatax.cli import preparing, train
from splatax.cli.planning import with_default_steps
from splatax.cli.settings import Settings
from splatax.cli.starting import tell_equal_weights, with_background
from splatax.dataset import PointCloud
from splatax.errors import FormatError
from splatax.inspection.decisions import Findings
from splatax.io.datasets.points import read_points, write_points
from splatax.reconstruction.bundle import Adjustment
from splatax.reconstruction.calibration import Correction, corrected

FOUND = PointCloud(np.tile(POINTS + [0, 0, 5], (4, 1)).astype(np.float32), np.full((120, 3), 0.2, np.float32))


def prepared(capture, out, **options):
    settings = Settings(capture, seed=1, **options)
    out.mkdir(exist_ok=True)
    return preparing.prepared(settings, preparing.loaded(settings), out)


def told_to_find(monkeypatch, points):
    monkeypatch.setattr(preparing.triangulation, "triangulated", lambda *_, **__: points)


@pytest.mark.parametrize("write", [write_transforms, write_llff])
def test_points_are_found_in_the_photos_of_a_capture_without_any(write, tmp_path, monkeypatch, capsys):
    told_to_find(monkeypatch, FOUND)
    capture = write(tmp_path / "capture")
    before = sorted(capture.rglob("*"))
    settings, dataset = prepared(capture, tmp_path / "out")
    assert settings.points == tmp_path / "out" / "points.ply"
    assert (settings.init, len(dataset.points)) == ("sfm", 120)
    assert "finding points in 8 photos" in capsys.readouterr().out
    again = preparing.loaded(settings)  # as a resumed run does
    assert_array_equal(again.points.positions, dataset.points.positions)
    assert sorted(capture.rglob("*")) == before


def test_where_too_few_points_are_found_training_starts_at_random_and_says_where(
    tmp_path, monkeypatch, capsys
):
    told_to_find(monkeypatch, PointCloud(FOUND.positions[:3], FOUND.colors[:3]))
    settings, dataset = prepared(write_transforms(tmp_path / "capture"), tmp_path / "out")
    assert (settings.init, settings.points, len(dataset.points)) == ("random", None, 0)
    out = capsys.readouterr().out
    assert "only 3 points found, at least 100 are needed" in out
    assert "starting from 20,000 random Gaussians in front of the cameras, " in out
    told_to_find(monkeypatch, None)  # and nothing is looked for if random is asked for
    assert prepared(write_llff(tmp_path / "b"), tmp_path / "out", init="random")[0].init == "random"


def test_a_capture_without_points_is_trained_and_the_run_repeated(tmp_path):
    """The photos are noise, so training starts at random."""
    capture, run = write_llff(tmp_path / "capture"), tmp_path / "run"
    cli.main(["train", str(capture), "--out", str(run), "--steps", "2", "--max-gaussians", "20000"])
    options = json.loads((run / "config.json").read_text())["options"]
    assert (options["init"], options["leave_out"], options["appearance"]) == ("random", "none", "none")
    cli.main(["train", "--repeat", str(run), "--out", str(tmp_path / "again")])
    assert (tmp_path / "again" / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()


def test_points_of_ones_own_are_started_from(tmp_path, capsys):
    write_points(tmp_path / "mine.ply", FOUND)
    assert_array_equal(read_points(tmp_path / "mine.ply").positions, FOUND.positions)
    capture = write_capture(tmp_path / "capture")
    dataset = preparing.loaded(Settings(capture, points=tmp_path / "mine.ply"))
    assert len(dataset.points) == 120
    assert "120 points from mine.ply" in dataset.notes
    assert "none.ply: no such file" in refused(capsys, "train", capture, "--points", tmp_path / "none.ply")


def test_every_decision_is_said_with_the_option_that_overrides_it(tmp_path, monkeypatch, capsys):
    findings = Findings(("photo01.png",), ("photo04.png",), {"photo02.png": "photo03.png"}, 0.31, 7, 9)
    monkeypatch.setattr(preparing, "look_first", lambda _: findings)
    monkeypatch.setattr(preparing, "warn_of_problems", lambda *_: None)
    capture = write_capture(tmp_path / "capture")
    settings, dataset = prepared(capture, tmp_path)
    assert settings.leave_out == "photo01.png\nphoto02.png\n"
    assert settings.appearance == "exposure"
    assert len(dataset.train) == 6
    assert capsys.readouterr().out.splitlines() == [
        "examined 7 of 9 photos in 5 s: the others stay in training, and exposure is judged without them. "
        "Decide yourself: --leave-out LIST, --appearance",
        "left out of training, blurred compared with the rest: photo01.png. Use all photos: --leave-out none",
        "left out of training, the same photo as another: photo02.png (as photo03.png). Use all photos: "
        "--leave-out none",
        "blurred compared with the rest, but used: photo04.png (at most 20% are left out, and none of 15 "
        "photos or fewer). Leave them out: --leave-out LIST",
        "exposure differs between photos by 0.31 stops (standard deviation), so it is compensated for. Turn "
        "that off: --appearance none",
    ]
    again = preparing.loaded(settings)  # as a resumed run does
    assert [view.name for view in again.train] == [view.name for view in dataset.train]
    assert "2 photos left out of training: photo01.png, photo02.png" in again.notes
    overridden, dataset = prepared(capture, tmp_path, leave_out="none", appearance="none")
    assert (overridden.leave_out, overridden.appearance, len(dataset.train)) == ("none", "none", 8)
    assert not capsys.readouterr().out


def test_problems_of_the_cameras_are_said_before_training(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(preparing, "look_first", lambda _: Findings())
    capture = write_capture(tmp_path / "capture", count=24)
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    for point in model.find_image_with_name("photo05.png").points2D:
        point.xy = point.xy + [3, 4]
    model.write_binary(capture / "sparse" / "0")
    prepared(capture, tmp_path)
    placed, points = capsys.readouterr().out.splitlines()
    assert placed.startswith("warning: 1 photo is placed worse than the rest: photo05.png. Remove them")
    assert points.startswith("warning: Only 30 points to start from. Find more with detail high of")
    prepared(capture, tmp_path, judged_by=tmp_path)
    assert "warning" not in capsys.readouterr().out  # said by the run that judges this one
    prepared(capture, tmp_path, init="random", leave_out="photo05.png")
    assert "warning" not in capsys.readouterr().out  # neither the photo nor the points are used


def test_a_sound_capture_is_not_warned_of(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(preparing, "look_first", lambda _: Findings(seen=24, photos=24))
    many = PointCloud(np.repeat(FOUND.positions, 5, axis=0), np.repeat(FOUND.colors, 5, axis=0))
    write_points(tmp_path / "points.ply", many)
    prepared(write_capture(tmp_path / "capture", count=24), tmp_path, points=tmp_path / "points.ply")
    assert capsys.readouterr() == ("", "")


def test_the_background_of_a_capture_is_said_with_the_option_that_overrides_it(tmp_path, capsys):
    dataset = sx.load_dataset(write_blender(tmp_path / "capture"))
    assert with_background(Settings(), dataset).background == "white"
    line = "background: white, the convention of Blender's captures. Change it: --background\n"
    assert capsys.readouterr().out == line
    assert with_background(Settings(background="random"), dataset).background == "random"
    assert with_background(Settings(), replace(dataset, background=None)).background is None
    assert not capsys.readouterr().out


def test_equal_weights_of_few_photos_are_said_with_the_option_that_overrides_them(tmp_path, capsys):
    few = preparing.loaded(Settings(write_capture(tmp_path / "few")))
    many = preparing.loaded(Settings(write_capture(tmp_path / "many", count=20)))
    tell_equal_weights(Settings(), few)
    assert capsys.readouterr().out == (
        "with only 8 training photos, those that do not fit the others keep their weight. Reduce it: "
        "--photo-weights robust\n"
    )
    tell_equal_weights(Settings(), many)
    tell_equal_weights(Settings(photo_weights="equal"), few)
    tell_equal_weights(Settings(recipe="classic"), few)  # which never weighs photos by default
    assert not capsys.readouterr().out


def test_the_default_number_of_steps_is_said_with_the_option_that_overrides_it(tmp_path, capsys):
    dataset = preparing.loaded(Settings(write_capture(tmp_path / "capture")))
    assert with_default_steps(Settings(recipe="classic"), dataset).steps == 30_000
    line = "30,000 steps, 3,750 for each of 8 photos. Choose another number: --steps\n"
    assert capsys.readouterr().out == line


def test_if_most_photos_would_be_left_out_all_are_used(tmp_path, monkeypatch, capsys):
    repeated = {f"photo0{i}.png": "photo08.png" for i in range(8)}
    monkeypatch.setattr(preparing, "look_first", lambda _: Findings(repeated=repeated))
    settings, dataset = prepared(write_capture(tmp_path / "capture"), tmp_path)
    assert (settings.leave_out, len(dataset.train)) == ("none", 8)
    assert "most photos are blurred or repeat another, so all are used" in capsys.readouterr().out


def test_photos_to_leave_out_can_be_named(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture")
    named = Settings(capture, leave_out="photo00,photo08.png").absolute()
    assert preparing.loaded(named).train[0].name == "photo01.png"
    assert len(preparing.loaded(named).train) == 6
    assert "no such photo" in refused(capsys, "train", capture, "--leave-out", "photo99", "--steps", 1)


def test_without_options_training_has_a_budget(tmp_path, monkeypatch, capsys):
    limited = []
    monkeypatch.setattr(train, "train", lambda run, live: limited.append(run.settings))
    cli.main(["train", "capture"])
    assert limited[-1].budget == "6min"
    assert "training for 6min. Choose another time: --budget" in capsys.readouterr().out
    for options in ("--steps 5", "--recipe classic", "--recipe mcmc --steps 7"):
        cli.main(["train", "capture", *options.split()])
        assert limited[-1].budget is None
    cli.main(["train", "capture", "--budget", "90s"])
    assert limited[-1].budget == "90s"


def test_a_limit_of_the_whole_command_leaves_time_for_the_results(tmp_path, capsys, monkeypatch):
    runs = []
    monkeypatch.setattr(train, "train", lambda run, live: runs.append(run))
    monkeypatch.setattr("splatax.runs.planning.busyness", lambda: 1.0)
    cli.main(["train", "capture", "--within", "100s"])
    (run,) = runs
    dataset = sx.load_dataset(write_capture(tmp_path / "capture"))
    assert 60 < run.deadline.left(dataset) < 96
    both = refused(capsys, "train", "capture", "--within", "9s", "--budget", "9s")
    assert "--within: limits the whole command, --budget the training" in both
    assert "--within: plans" in refused(capsys, "train", "capture", "--within", "9s", "--steps", 4)
    assert "--within: a resumed or repeated run" in refused(
        capsys, "train", "--resume", "runs/x", "--within", "9s"
    )


def test_held_out_photos_can_be_chosen_and_eval_keeps_to_them(tmp_path, capsys):
    capture, run = write_capture(tmp_path / "capture"), tmp_path / "run"
    cli.main(["train", str(capture), "--out", str(run), "--steps", "2", "--hold-out", "last:2"])
    protocol = json.loads((run / "metrics.json").read_text())["protocol"]
    assert protocol["split"] == "held out: the last 2 photos by name"
    cli.main(["eval", str(run), str(capture), "--out", str(tmp_path / "eval.json")])
    scores = json.loads((tmp_path / "eval.json").read_text())
    assert [view["name"] for view in scores["views"]] == ["photo07.png", "photo08.png"]
    cli.main(["eval", str(run), str(capture), "--out", str(tmp_path / "e.json"), "--hold-out", "every:8:1"])
    other = json.loads((tmp_path / "e.json").read_text())
    assert [view["name"] for view in other["views"]] == ["photo00.png", "photo08.png"]


def test_a_run_on_all_photos_does_not_pass_for_a_test(tmp_path):
    capture, run = write_capture(tmp_path / "capture"), tmp_path / "run"
    cli.main(["train", str(capture), "--out", str(run), "--steps", "2", "--hold-out", "none"])
    assert json.loads((run / "metrics.json").read_text())["test"] is None
    report = (run / "report.html").read_text()
    assert "PSNR of 9 photos that it was trained on" in report
    assert "trained on all 9 photos, so none of them can show" in report


def test_version_is_printed(capsys):
    cli.main(["--version"])
    assert capsys.readouterr().out == f"splatax {sx.__version__}\n"


FOUND_LENS = Correction((1.02, 1.02), "RADIAL", (-0.1, 0.02))


def adjusted_to(monkeypatch, helps):
    """Bundle adjustment finds training cameras a little to the right and their lens, or does not help."""

    def found(views, free, **_):
        shift = np.eye(4, dtype=np.float32)
        shift[0, 3] = 0.01
        moved = tuple(
            replace(v, camera=replace(v.camera, cam_from_world=shift @ v.camera.cam_from_world))
            for v in views
        )
        lenses = {v.name: FOUND_LENS for v in views} if free == "poses+lens" else {}
        if not helps:
            return Adjustment(tuple(views), tuple(views), {}, 0.9, 0.95, 0.31, 2000)
        return Adjustment(tuple(views), corrected(moved, lenses), lenses, 0.9, 0.4, 0.31, 2000)

    monkeypatch.setattr(preparing.bundle, "adjusted_cameras", found)


@pytest.mark.slow
def test_adjusted_cameras_are_trained_on_said_and_kept_for_repeating(tmp_path, monkeypatch, capsys):
    adjusted_to(monkeypatch, helps=True)
    capture, run = write_capture(tmp_path / "capture"), tmp_path / "run"
    settings, dataset = prepared(capture, tmp_path / "out", adjust_cameras="poses+lens")
    given = preparing.loaded(Settings(capture))
    assert settings.cameras == tmp_path / "out" / "cameras.json"
    said = capsys.readouterr().out
    assert "reprojection error 0.90 to 0.40 px" in said
    assert "focal length times 1.0200, RADIAL -0.1 0.02" in said
    again = preparing.loaded(settings)  # as a resumed run does
    for ours, theirs, before in zip(dataset.views, again.views, given.views, strict=True):
        for a, b in zip(jax.tree.leaves(ours.camera), jax.tree.leaves(theirs.camera), strict=True):
            assert_array_equal(a, b)
        assert_array_equal(ours.camera.lens.radials[:2], np.float32([-0.1, 0.02]))  # held out: the same lens
        assert_array_equal(ours.camera.fx, np.float32(np.float64(before.camera.fx) * 1.02))
    for ours, before in zip(dataset.train, given.train, strict=True):
        assert not np.array_equal(ours.camera.cam_from_world, before.camera.cam_from_world)
    for ours, before in zip(dataset.test, given.test, strict=True):  # held out: no part in it
        assert_array_equal(ours.camera.cam_from_world, before.camera.cam_from_world)
    small, given_small = (preparing.loaded(s, downscale=2) for s in (settings, Settings(capture)))
    for ours, before in zip(small.views, given_small.views, strict=True):
        assert_array_equal(ours.camera.fx, np.float32(np.float64(before.camera.fx) * 1.02))

    options = ["--out", str(run), "--steps", "2", "--adjust-cameras", "poses+lens"]
    cli.main(["train", str(capture), *options])
    metrics = json.loads((run / "metrics.json").read_text())
    assert len(metrics["adjusted_poses"]["views"]) == len(given.test)
    assert "with poses adjusted to these photos" in (run / "report.html").read_text()
    monkeypatch.setattr(preparing.bundle, "adjusted_cameras", None)  # not asked again
    cli.main(["train", "--repeat", str(run), "--out", str(tmp_path / "again")])
    assert (tmp_path / "again" / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()
    cli.main(["eval", str(run), str(capture), "--out", str(tmp_path / "eval.json")])
    assert json.loads((tmp_path / "eval.json").read_text())["psnr"] == pytest.approx(metrics["test"]["psnr"])


def test_given_cameras_are_kept_where_adjusting_does_not_help(tmp_path, monkeypatch, capsys):
    adjusted_to(monkeypatch, helps=False)
    capture = write_capture(tmp_path / "capture")
    settings, dataset = prepared(capture, tmp_path / "out", adjust_cameras="poses+lens")
    given = preparing.loaded(Settings(capture))
    assert settings.cameras is None
    assert not (tmp_path / "out" / "cameras.json").exists()
    assert "given cameras kept, as adjusting them does not help" in capsys.readouterr().out
    for ours, before in zip(dataset.train, given.train, strict=True):
        assert_array_equal(ours.camera.cam_from_world, before.camera.cam_from_world)


@pytest.mark.parametrize(
    "damage",
    [
        '{"photo00.png": [[1, 0], [0, 1]]}',
        '{"poses": {"photo01.png": [[1, 0], [0, 1]]}, "lenses": {}}',
        '{"poses": {}, "lenses": {"photo01.png": {"focal": [1], "model": "RADIAL", "coefficients": []}}}',
        '{"poses": {}, "lenses": {"photo01.png": {"focal": [1, 1], "model": "NONE", "coefficients": []}}}',
        '{"poses": {}, "lenses": {"photo01.png": {"focal": [1, 1], "model": "FOV", "coefficients": [NaN]}}}',
    ],
)
def test_a_damaged_file_of_cameras_is_refused(tmp_path, damage):
    capture, path = write_capture(tmp_path / "capture"), tmp_path / "cameras.json"
    path.write_text(damage)
    with pytest.raises(FormatError, match=r"cameras\.json: damaged"):
        preparing.loaded(Settings(capture, cameras=path))
