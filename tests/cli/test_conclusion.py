"""Finished training is not lost if writing its results fails or is interrupted."""

import errno
import json
import os

import pytest
from test_refusals import refused

from splatax import cli
from splatax.report import training
from splatax.runs import results, session
from splatax.web import page

STEPS = 6
FILES = {"scene.ply", "metrics.json", "config.json", "held_out.json", "report.html", "progress.gif"}


class PowerCut(Exception):
    """Ends a process where it is."""


def start(capture, out, *options):
    cli.main(["train", str(capture), "--out", str(out), "--steps", str(STEPS), *options])


def no_training(*_):
    pytest.fail("trained again")


def same_results(run, whole):
    """Checks that a run ended as another that was never stopped."""
    assert {path.name for path in run.iterdir()} == FILES
    for name in ("scene.ply", "progress.gif", "held_out.json"):
        assert (run / name).read_bytes() == (whole / name).read_bytes()
    ours, theirs = (json.loads((folder / "metrics.json").read_text()) for folder in (run, whole))
    for key in ("test", "steps", "gaussians", "final_loss", "interrupted", "bad_steps", "broken_gaussians"):
        assert ours[key] == theirs[key]
    assert [(e["step"], e["psnr"]) for e in ours["evaluations"]] == [
        (e["step"], e["psnr"]) for e in theirs["evaluations"]
    ]


@pytest.mark.parametrize("moment", ["compared", "write_json", "report"])
def test_a_run_killed_while_its_results_are_written_is_concluded_without_training(
    moment, trained, capture, tmp_path, monkeypatch
):
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(
            training if moment == "report" else results,
            moment,
            lambda *_, **__: (_ for _ in ()).throw(PowerCut),
        )
        with pytest.raises(PowerCut):
            start(capture, run, "--eval-every", "3", "--checkpoint-every", "0")
    assert not (run / "report.html").exists()
    monkeypatch.setattr(session, "optimize", no_training)
    cli.main(["train", "--resume", str(run)])
    same_results(run, trained)


def test_ctrl_c_while_results_are_written_says_how_to_write_them(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(training, "report", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(SystemExit) as exit:
        start(capture, tmp_path)
    assert exit.value.code == 130
    assert f"splatax train --resume {tmp_path}" in capsys.readouterr().err


def full_for(monkeypatch, *names):
    """Makes the disk full for files of some names; returns what frees it."""
    replace = os.replace

    def full(source, target):
        if os.path.basename(target) in names:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source, None, target)
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    return lambda: monkeypatch.setattr(os, "replace", replace)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scene.ply", "metrics.json", "report.html"])
def test_a_full_disk_after_the_last_step_loses_nothing(name, trained, capture, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    free = full_for(monkeypatch, name)
    error = refused(capsys, "train", capture, "--out", run, "--steps", STEPS, "--eval-every", 3)
    assert f"{run / name}: no space is left (the disk at /" in error
    assert "bytes free)" in error
    assert f"See --resume {run}." in error
    free()
    monkeypatch.setattr(session, "optimize", no_training)
    cli.main(["train", "--resume", str(run)])
    same_results(run, trained)


def test_a_disk_too_full_for_the_last_checkpoint_still_gets_the_scene(capture, tmp_path, monkeypatch, capsys):
    full_for(monkeypatch, f"{STEPS:08}.npz")
    start(capture, tmp_path / "run")
    assert (tmp_path / "run" / "report.html").exists()
    assert "the end of training cannot be saved" in capsys.readouterr().err


def test_a_scene_without_report_and_checkpoint_is_not_called_finished(tmp_path, capsys):
    (tmp_path / "scene.ply").touch()
    assert "neither its report nor a checkpoint" in refused(capsys, "train", "--resume", tmp_path)


@pytest.mark.slow
def test_create_concludes_a_run_that_was_killed_while_its_results_were_written(
    capture, tmp_path, monkeypatch
):
    (tmp_path / "viewer.js").touch()
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    command = ["create", str(capture), "--out", str(tmp_path / "out"), "--steps", str(STEPS)]
    whole = training.report

    def cut(title, *rest):
        if title == "out":
            raise PowerCut
        return whole(title, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(training, "report", cut)
        with pytest.raises(PowerCut):
            cli.main(command)
    monkeypatch.setattr(session, "optimize", no_training)
    cli.main(command)
    page_of_run = (tmp_path / "out" / "run" / "report.html").read_text()
    assert "PSNR of 1 photo that a trial run held out" in page_of_run
    assert (tmp_path / "out" / "scene.html").exists()
