"""`splatax create`, from photos or a capture to a page."""

import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest
from test_refusals import refused

import splatax as sx
from captures import write_capture, write_transforms
from splatax import cli
from splatax.cli import create
from splatax.cli.options import flag
from splatax.cli.train import Train
from splatax.cli.train_options import Rerun
from splatax.errors import InputError
from splatax.web import page


@pytest.fixture
def stub(tmp_path_factory, monkeypatch):
    """A viewer that is none."""
    path = tmp_path_factory.mktemp("viewer") / "viewer.js"
    path.write_text("")
    monkeypatch.setattr(page, "VIEWER", path)


def test_all_photos_are_trained_on_and_the_score_is_of_photos_that_a_trial_had_not_seen(
    stub, capture, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "out"
    command = ["create", str(capture), "--out", str(out), "--steps", "12", "--open"]
    opened = []
    monkeypatch.setattr(create.webbrowser, "open", opened.append)
    cli.main(command)
    told = capsys.readouterr().out
    assert "trial run without 1 of 9 photos" in told
    assert str(out / "scene.html") in told
    assert opened == [(out / "scene.html").as_uri()]
    trial, run = (json.loads((out / name / "metrics.json").read_text()) for name in ("trial", "run"))
    assert (trial["steps"], run["steps"]) == (2, 12)
    assert [view["name"] for view in trial["test"]["views"]] == ["photo04.png"]
    assert run["test"] is None
    assert run["judged_by"]["test"] == trial["test"]
    report = (out / "run" / "report.html").read_text()
    headline = f"<b>{trial['test']['psnr']:.2f} dB</b><span>PSNR of 1 photo that a trial run held out"
    assert headline in report
    assert report.index(headline) < report.index("PSNR of 9 photos that it was trained on")
    assert "The scene was trained on all 9 photos." in report
    opening = report[: report.index("<h2>Numbers</h2>")]
    assert 'alt="photo photo04.png"' in opening
    assert "the scene of the trial run from there" in opening
    assert opening.count("<figcaption>") == 2  # of the one photo that the trial held out
    assert "<h1>out</h1>" in report
    assert "<h1>out</h1>" in (out / "scene.html").read_text()

    (out / "scene.html").unlink()
    monkeypatch.setattr(create.Train, "run", lambda self: pytest.fail("trained again"))
    cli.main(command)
    assert (out / "scene.html").exists()


def test_without_a_viewer_nothing_is_begun(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "VIEWER", tmp_path / "none.js")
    with pytest.raises(SystemExit) as exit:
        cli.main(["create", str(capture), "--out", str(tmp_path / "out")])
    assert exit.value.code == 2
    assert "make page" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_photos_that_are_not_there_are_refused(stub, tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["create", str(tmp_path / "photos"), "--out", str(tmp_path / "out")])
    assert "no such folder" in capsys.readouterr().err


@pytest.fixture
def stages(stub, capture, monkeypatch):
    """Stages that take no time, and are listed when they come to an end; `stop` names one that does not."""

    class Stages(list):
        def __init__(self):
            self.stop, self.runs, self.reconstructions = None, [], []

        def do(self, stage, *written):
            if stage == self.stop:
                raise KeyboardInterrupt
            for path in written:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch()
            self.append(stage)

    done = Stages()
    monkeypatch.setattr(create, "is_capture", lambda path: (path / "sparse").exists())

    def reconstruct(self):
        done.reconstructions.append(self)
        done.do("reconstruct", self.out / "sparse", self.out / "images")

    monkeypatch.setattr(create.Reconstruct, "run", reconstruct)
    monkeypatch.setattr(create, "load_scene", lambda *_: sx.load_dataset(capture))

    def train(self):
        done.runs.append(self)
        done.do("trial" if self.photos.hold_out is None else "train", self.out / "report.html")

    monkeypatch.setattr(create.Train, "run", train)
    monkeypatch.setattr(create.Page, "run", lambda self: done.do("page", self.out))
    return done


@pytest.fixture
def photos(tmp_path):
    (tmp_path / "photos").mkdir()
    return tmp_path / "photos"


@pytest.mark.parametrize("stage", ["reconstruct", "trial", "train", "page"])
def test_stopped_in_any_stage_the_same_command_goes_on_with_it(stages, photos, tmp_path, capsys, stage):
    command = ["create", str(photos), "--out", str(tmp_path / "out")]
    stages.stop = stage
    with pytest.raises(SystemExit) as exit:
        cli.main(command)
    assert exit.value.code == 130
    assert capsys.readouterr().err == "splatax: stopped. Run the same command again to resume\n"
    stages.stop = None
    cli.main(command)
    assert stages == ["reconstruct", "trial", "train", "page"]
    assert str(tmp_path / "out" / "scene.html") in capsys.readouterr().out


@pytest.mark.parametrize("given", [[], ["--undistort", "--panoramas", "all"]])
def test_the_capture_keeps_the_photos_as_they_are_unless_asked_otherwise(stages, photos, tmp_path, given):
    cli.main(["create", str(photos), "--out", str(tmp_path / "out"), *given])
    (made,) = stages.reconstructions
    assert made.undistort is bool(given)
    assert made.cameras.panoramas == ("all" if given else "auto")
    assert all(run.photos.undistort is bool(given) for run in stages.runs)


def test_a_run_that_was_killed_before_its_report_is_made_again(stages, photos, tmp_path):
    (tmp_path / "out" / "run").mkdir(parents=True)
    (tmp_path / "out" / "run" / "scene.ply").touch()
    cli.main(["create", str(photos), "--out", str(tmp_path / "out")])
    assert "train" in stages


def test_what_was_made_of_other_photos_or_for_another_time_is_replaced_only_when_told(
    stages, photos, tmp_path, capsys
):
    command = ["create", photos, "--out", tmp_path / "out"]
    cli.main([*map(str, command), "--budget", "60s"])
    cli.main([*map(str, command), "--budget", "1min"])
    assert stages == ["reconstruct", "trial", "train", "page", "page"]
    error = refused(capsys, *command, "--budget", "2min")
    assert "made with --budget 1:00 min, not with --budget 2:00 min" in error
    assert f"splatax create {tmp_path / 'out' / 'capture'} --out OTHER" in error
    error = refused(capsys, *command, "--budget", "2min", "--frames", "12")
    assert "made with --frames 200, not with --frames 12. Find the cameras again" in error
    assert f"splatax create {photos} --out OTHER" in error
    (tmp_path / "others").mkdir()
    error = refused(capsys, "create", tmp_path / "others", "--out", tmp_path / "out", "--budget", "60s")
    assert f"made from {photos}" in error
    del stages[:]
    cli.main([*map(str, command), "--budget", "2min", "--overwrite"])
    assert stages == ["reconstruct", "trial", "train", "page"]


def groups(command):
    """The groups of options of a command, by the name that they have in it."""
    return {name: kind for name, kind in get_type_hints(command).items() if is_dataclass(kind)}


def test_create_has_every_group_of_options_of_train_but_that_of_earlier_runs():
    missing = set(groups(Train).values()) - set(groups(create.Create).values())
    assert missing == {Rerun}  # the same command, typed again, resumes


EXAMPLES = {  # of options of `train`; a new option needs one
    "hold_out": "last",
    "leave_out": "none",
    "undistort": True,
    "points": Path("points.ply"),
    "judged_by": Path("earlier"),
    "budget": "60s",
    "within": "100s",
    "memory": "4GB",
    "steps": 60,
    "max_gaussians": 500,
    "downscale": 2,
    "views": 2,
    "hosts": "auto",
    "recipe": "mcmc",
    "init": "random",
    "sky": True,
    "background": "white",
    "low_pass": "antialiasing",
    "order": "depth",
    "appearance": "exposure",
    "refine": "poses",
    "adjust_cameras": "poses",
    "geometry": True,
    "geometry_after": 0.5,
    "photo_weights": "equal",
    "backend": "xla",
    "seed": 3,
    "eval_every": 5,
    "checkpoint_every": 7.0,
    "checkpoint_steps": 9,
    "view": True,
    "host": "0.0.0.0",
    "port": 9000,
}
REFUSED = {"hosts": "run in one process"}
TOGETHER = {"geometry_after": ["--geometry"]}  # options that make sense only beside others


@pytest.mark.parametrize(
    ("group", "name"),
    [
        (group, field.name)
        for group, kind in groups(Train).items()
        if kind is not Rerun
        for field in fields(kind)
    ],
)
def test_each_option_of_train_can_be_given(stages, photos, tmp_path, capsys, group, name):
    value = EXAMPLES[name]
    typed = [flag(name)] if value is True else [flag(name), str(value)]
    command = ["create", str(photos), "--out", str(tmp_path / "out"), *typed, *TOGETHER.get(name, [])]
    if name in REFUSED:
        assert REFUSED[name] in refused(capsys, *command)
        return
    cli.main(command)
    taken = getattr(getattr(stages.runs[-1], group), name)
    if name in ("budget", "within"):
        assert taken.endswith("s")  # a part of it: the trial run and the page take the rest
    else:
        assert taken == value


def test_options_of_both_stages_reach_both(stages, photos, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        create.Reconstruct, "run", lambda self: seen.append(self) or (self.out / "sparse").mkdir(parents=True)
    )
    options = (
        "--frames 50 --downscale 2 --memory 4GB --recipe mcmc --steps 60 --seed 3 --view --leave-out none"
    )
    cli.main(["create", str(photos), "--out", str(tmp_path / "out"), *options.split()])
    assert (seen[0].cameras.frames, seen[0].seed) == (50, 3)
    trial, run = stages.runs
    assert [each.limits.steps for each in stages.runs] == [10, 60]
    assert {each.limits.downscale for each in stages.runs} == {2}
    assert {each.method.recipe for each in stages.runs} == {"mcmc"}
    assert {each.photos.leave_out for each in stages.runs} == {"none"}
    assert (trial.live.view, run.live.view) == (False, True)
    assert run.photos.judged_by == trial.out


def test_the_time_of_training_is_shared_between_the_trial_and_the_scene(stages, photos, tmp_path):
    cli.main(["create", str(photos), "--out", str(tmp_path / "a"), "--budget", "60s"])
    assert [run.limits.budget for run in stages.runs] == ["10s", "50s"]
    del stages.runs[:]
    cli.main(["create", str(photos), "--out", str(tmp_path / "b"), "--within", "70s"])  # 10 s for the page
    seconds = [float(run.limits.within.rstrip("s")) for run in stages.runs]
    assert 5 <= seconds[0] <= 10
    assert 5 * seconds[0] < seconds[1] <= 60


def test_the_default_time_of_training_is_said_with_the_option_that_overrides_it(
    stages, photos, tmp_path, capsys
):
    line = "training for 10min in all. Choose another time: --budget"
    cli.main(["create", str(photos), "--out", str(tmp_path / "a")])
    assert line in capsys.readouterr().out
    cli.main(["create", str(photos), "--out", str(tmp_path / "b"), "--budget", "10min"])
    assert "training for" not in capsys.readouterr().out


def test_without_a_plan_the_steps_of_the_trial_are_said_and_training_chooses_those_of_the_scene(
    stages, photos, tmp_path, capsys
):
    cli.main(["create", str(photos), "--out", str(tmp_path / "out"), "--recipe", "2dgs"])
    assert [run.limits.steps for run in stages.runs] == [5_000, None]
    line = "5,000 steps, a sixth of those of the scene. Choose another number: --steps"
    assert line in capsys.readouterr().out


def test_a_run_named_as_judge_makes_a_trial_unnecessary(stages, photos, tmp_path):
    cli.main(["create", str(photos), "--out", str(tmp_path / "out"), "--judged-by", "earlier"])
    assert stages == ["reconstruct", "train", "page"]
    (run,) = stages.runs
    assert (run.photos.hold_out, run.photos.judged_by, run.limits.budget) == ("none", Path("earlier"), "600s")


def test_held_out_photos_of_ones_own_choice_make_a_trial_unnecessary(stages, photos, tmp_path):
    cli.main(["create", str(photos), "--out", str(tmp_path / "out"), "--hold-out", "last"])
    assert stages == ["reconstruct", "train", "page"]
    assert (stages.runs[0].photos.hold_out, stages.runs[0].limits.budget) == ("last", "600s")


def test_a_capture_too_small_to_hold_photos_out_has_no_trial(stages, photos, tmp_path, monkeypatch, capsys):
    small = write_capture(tmp_path / "small", count=4)
    monkeypatch.setattr(create, "load_scene", lambda *_: sx.load_dataset(small))
    cli.main(["create", str(photos), "--out", str(tmp_path / "out")])
    assert stages == ["reconstruct", "train", "page"]
    assert "4 photos are too few to hold some out, so the scene has no score" in capsys.readouterr().out


@pytest.mark.parametrize("found", [True, False])
def test_points_of_a_capture_without_any_are_looked_for_once(found, stages, photos, tmp_path, monkeypatch):
    bare, asked = sx.load_dataset(write_transforms(tmp_path / "bare")), []

    def found_points(capture, views, out, seed):
        asked.append(len(views))
        return out / "points.ply" if found else None

    monkeypatch.setattr(create, "load_scene", lambda *_: bare)
    monkeypatch.setattr(create, "found_points", found_points)
    cli.main(["create", str(photos), "--out", str(tmp_path / "out")])
    assert asked == [9]  # all photos, as COLMAP's points of a capture are from all of them
    path = tmp_path / "out" / "points.ply"
    assert {run.photos.points for run in stages.runs} == {path if found else None}
    assert {run.method.init for run in stages.runs} == {None if found else "random"}


def test_nothing_is_begun_that_cannot_end_well(stages, photos, tmp_path, capsys):
    out = tmp_path / "out"
    assert "--budget: a time such as" in refused(capsys, "create", photos, "--out", out, "--budget", "soon")
    error = refused(capsys, "create", photos, "--out", photos / "out")
    assert f"{photos / 'out'}: lies among the photos" in error
    assert "--within: plans" in refused(
        capsys, "create", photos, "--out", out, "--within", "9s", "--steps", 5
    )
    assert "--hold-out: " in refused(capsys, "create", photos, "--out", out, "--hold-out", "every:1")
    (tmp_path / "file").touch()
    assert "a file, not a folder" in refused(capsys, "create", photos, "--out", tmp_path / "file")
    assert not stages
    assert not out.exists()


@pytest.mark.parametrize("place", ["", "images", "images/out"])
def test_a_page_is_not_made_among_the_files_of_its_capture(stub, tmp_path, capsys, place):
    capture = write_capture(tmp_path / "capture")
    before = sorted(capture.rglob("*"))
    error = refused(capsys, "create", capture, "--out", capture / place, "--steps", "12")
    why = f"lies among the photos of {capture}" if place else "the folder of the capture itself"
    assert f"{capture / place}: {why}. Choose another --out" in error
    assert sorted(capture.rglob("*")) == before


def test_a_page_may_lie_in_a_folder_of_its_own_inside_its_capture(stub, tmp_path):
    capture = write_transforms(tmp_path / "capture")
    (capture / "all").mkdir()
    (capture / "images").rename(capture / "all" / "images")
    listing = capture / "transforms.json"
    listing.write_text(listing.read_text().replace("images/", "all/images/"))
    create.Create(capture, capture / "out").refuse_what_cannot_be_made()
    with pytest.raises(InputError, match="lies among the photos"):
        create.Create(capture, capture / "all").refuse_what_cannot_be_made()
