"""`splatax train --hosts`: processes that run the same command train one scene, which process 0 writes."""

import socket
import subprocess
import sys
from collections import deque
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_preparing import FOUND
from test_refusals import refused

from captures import write_capture, write_transforms
from emitters import as_users_compile
from splatax import backends, cli
from splatax.cli import hosts, train, training
from splatax.cli.preparing import loaded
from splatax.cli.settings import Settings
from splatax.cli.starting import NewRun
from splatax.cli.train_options import Live, Saving
from splatax.io.datasets.points import write_points
from splatax.runs.cameras import write_cameras
from splatax.training.fingerprints import fingerprint

needs_cpu = pytest.mark.skipif(
    backends.why_unavailable("cpu") is not None, reason="only the native backend computes each row alone"
)
PROGRAM = "import sys\nfrom splatax.cli import main\n{before}\nmain(sys.argv[1:])"
IDLE = """
from splatax.cli import starting, training
from splatax.runs import session
from splatax.training import checkpoint
starting.prepared = starting.planned = training.written = None
session.evaluate = session.picture = checkpoint.take = checkpoint.write = None
"""  # a process that decides, evaluates, draws or saves anything fails
KILLED = """
import os, signal, time
from splatax.training.steppers import SeveralViews
step, made = SeveralViews.step, []
def deadly(*arguments):
    made.append(None)
    if len(made) == 4:
        time.sleep(2)  # for the checkpoint of step 2, which a thread writes
        os.kill(os.getpid(), signal.SIGKILL)
    return step(*arguments)
SeveralViews.step = deadly
"""


def program(capture, out, *options, before=""):
    sizes = ("--steps", "5", "--views", "2", "--max-gaussians", "300", "--eval-every", "2")
    arguments = ("train", str(capture), "--out", str(out), *sizes, *options)
    return [sys.executable, "-c", PROGRAM.format(before=before), *arguments]


def by_two(captures, outs, *options, before=("", "")):
    """Runs a command in two processes; returns what each prints on its two streams, and exit codes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = [
        subprocess.Popen(
            program(captures[i], outs[i], "--hosts", f"127.0.0.1:{port},2,{i}", *options, before=before[i]),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=as_users_compile(),
        )
        for i in (0, 1)
    ]
    printed = [process.communicate(timeout=900) for process in processes]
    return printed, [process.returncode for process in processes]


@pytest.fixture(scope="module")
def alone(capture, tmp_path_factory):
    """The scene of one process."""
    out = tmp_path_factory.mktemp("alone") / "run"
    subprocess.run(program(capture, out), check=True, capture_output=True, env=as_users_compile())
    return (out / "scene.ply").read_bytes()


@needs_cpu
@pytest.mark.slow
def test_two_processes_write_the_scene_of_one_and_only_process_0_decides_and_writes(capture, tmp_path, alone):
    outs = [tmp_path / "both", tmp_path / "other"]
    printed, codes = by_two([capture] * 2, outs, "--checkpoint-steps", "2", before=("", IDLE))
    assert codes == [0, 0], printed
    assert (outs[0] / "scene.ply").read_bytes() == alone
    assert not outs[1].exists()
    assert "test PSNR" in printed[0][0]
    assert not any(word in printed[1][0] for word in ("photos", "PSNR", "report"))


@needs_cpu
@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_if_one_process_is_killed_the_other_ends_and_one_alone_resumes_to_the_same_bits(
    capture, tmp_path, alone, victim
):
    out = tmp_path / "both"
    before = [KILLED if i == victim else "" for i in (0, 1)]
    printed, codes = by_two([capture] * 2, [out] * 2, "--checkpoint-steps", "2", before=before)
    assert codes[victim] == -9, printed
    assert codes[1 - victim] != 0, printed
    assert not (out / "scene.ply").exists()
    resume = [sys.executable, "-m", "splatax", "train", "--resume", str(out)]
    subprocess.run(resume, check=True, capture_output=True, env=as_users_compile())
    assert (out / "scene.ply").read_bytes() == alone


@needs_cpu
@pytest.mark.slow
def test_processes_with_different_captures_end_before_the_first_step_and_name_the_difference(
    capture, tmp_path
):
    other = write_capture(tmp_path / "other", count=7)
    printed, codes = by_two([capture, other], [tmp_path / "run"] * 2)
    assert codes == [2, 2], printed
    for _, errors in printed:
        assert "the processes of the run differ in: photos" in errors
        assert "8 to train on and 1 held out in process 0 and 6 to train on" in errors
        assert "Traceback" not in errors


@needs_cpu
@pytest.mark.slow
def test_the_other_processes_tell_why_process_0_has_exited(capture, tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    (out / "scene.ply").touch()
    printed, codes = by_two([capture] * 2, [out] * 2)
    assert codes == [2, 2], printed
    assert f"{out}: holds the results of a run" in printed[0][1]
    assert f"process 0 has ended the run: {out}: holds the results of a run" in printed[1][1]


def test_the_decisions_of_process_0_are_received_with_the_files_that_they_name(tmp_path, monkeypatch):
    sent = deque()

    monkeypatch.setattr(hosts, "broadcast", sent.append)
    monkeypatch.setattr(hosts, "receive", sent.popleft)
    monkeypatch.setattr(hosts.jax, "process_count", lambda: 2)
    capture, points, cameras = (tmp_path / name for name in ("capture", "points.ply", "cameras.json"))
    write_transforms(capture)
    write_points(points, FOUND)
    given = loaded(Settings(capture))
    pose = np.asarray(given.train[0].camera.cam_from_world) + np.float32(0.125)
    moved = replace(given.train[0], camera=replace(given.train[0].camera, cam_from_world=pose))
    write_cameras(cameras, [moved], {})
    settings = Settings(capture, seed=3, leave_out=f"{given.train[1].name}\n", points=points, cameras=cameras)
    decided = loaded(settings)
    hosts.send_settings(settings)

    points.unlink()
    cameras.unlink()
    elsewhere = capture.rename(tmp_path / "elsewhere")
    received, dataset = hosts.receive_settings(Settings(elsewhere, seed=1))
    assert not sent
    assert (received.scene, received.seed) == (elsewhere, 3)
    assert fingerprint(dataset) == fingerprint(decided)
    assert fingerprint(dataset)["camera of"] != fingerprint(given)["camera of"]
    assert len(dataset.points) == len(FOUND)


@pytest.fixture
def as_one_of_two(monkeypatch):
    """Pretends that the command runs in one of two processes; returns the runs that it would train."""
    runs = []
    monkeypatch.setattr(train, "joined", lambda hosts: nullcontext())
    monkeypatch.setattr(train.jax, "process_count", lambda: 2)
    monkeypatch.setattr(train, "train", lambda run, live: runs.append(run))
    return runs


@pytest.mark.parametrize(
    ("options", "steps", "line"),
    [
        ((), 500, "saving a checkpoint every 500 steps. Choose another number: --checkpoint-steps\n"),
        (("--checkpoint-every", "0"), 500, "every 500 steps"),
        (("--checkpoint-steps", "7"), 7, ""),
        (("--checkpoint-steps", "0"), 0, ""),
    ],
)
def test_a_run_on_several_hosts_saves_by_steps_unless_told_otherwise(
    capsys, capture, as_one_of_two, options, steps, line
):
    cli.main(["train", str(capture), "--hosts", "auto", "--views", "2", *options])
    (run,) = as_one_of_two
    assert (run.settings.checkpoint_every, run.settings.checkpoint_steps) == (0, steps)
    printed = capsys.readouterr().out
    assert line in printed if line else "checkpoint" not in printed


def test_a_resumed_run_on_several_hosts_keeps_its_steps_between_checkpoints(as_one_of_two):
    saved = Settings(Path("noise"), views=2, checkpoint_steps=300)
    run = hosts.among_processes(NewRun(saved), Saving(), Live())
    assert (run.settings.checkpoint_every, run.settings.checkpoint_steps) == (0, 300)


def test_saving_by_the_clock_is_refused_on_several_hosts(capsys, capture, as_one_of_two):
    options = ("--hosts", "auto", "--views", "2", "--checkpoint-every", "60")
    error = refused(capsys, "train", capture, *options)
    assert "--checkpoint-every 60: several processes cannot save by the clock" in error
    assert "Give --checkpoint-steps N instead." in error
    assert not as_one_of_two


@pytest.mark.parametrize("options", [("--views", "2", "--view"), ()])
def test_the_live_viewer_and_steps_on_one_photo_are_refused_on_several_hosts(
    capsys, capture, as_one_of_two, options
):
    error = refused(capsys, "train", capture, "--hosts", "auto", *options)
    assert "--hosts: needs --views, and cannot be used with --view." in error


def test_hosts_that_make_no_sense_are_refused(capsys, capture):
    assert "ADDRESS:PORT,COUNT,INDEX" in refused(capsys, "train", capture, "--hosts", "10.0.0.1,2")


def test_several_photos_a_step_see_as_many_photos_as_one_a_step_by_default(
    capsys, capture, tmp_path, monkeypatch
):
    recipes = []

    def make_steps(session, start, live):
        recipes.append(session.recipe)
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "make_steps", make_steps)
    with pytest.raises(SystemExit):
        cli.main(["train", str(capture), "--views", "8", "--out", str(tmp_path / "run")])
    assert [(recipe.steps, recipe.views) for recipe in recipes] == [(3_750, 8)]
    line = "3,750 steps of 8 photos, 30,000 photos in all. Choose another number: --steps\n"
    assert line in capsys.readouterr().out


@pytest.mark.parametrize("limit", ["--budget", "--within"])
def test_a_time_is_not_planned_for_several_photos_a_step(capsys, capture, limit):
    error = refused(capsys, "train", capture, "--views", "4", limit, "5min")
    assert error.startswith(f"splatax: {limit}: steps are planned by the measured speed")
    assert "--steps" in error
