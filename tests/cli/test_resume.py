"""A run that was stopped and resumed ends with the same bytes as an uninterrupted one."""

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import splatax as sx
from captures import write_capture
from shortened import shortened
from splatax import cli
from splatax.runs import resume, session
from splatax.runs.machine import DECISIVE, versions
from splatax.training.recipes import PRESETS, ShSchedule

STEPS = 24


class PowerCut(Exception):
    """Ends a run where it is."""


def ending_at(step):
    """Training that ends after a step, before it can save itself once more."""

    def optimize(*arguments):
        for progress in sx.training.loop.optimize(*arguments):
            if progress.step == step:
                raise PowerCut
            yield progress

    return optimize


@pytest.fixture
def stopped_at(monkeypatch):
    """Makes the next runs end after a step."""
    return lambda step: monkeypatch.setattr(session, "optimize", ending_at(step))


def start(capture, out, *options):
    arguments = ["train", capture, "--out", out, "--steps", STEPS, "--checkpoint-steps", 5, *options]
    cli.main([str(argument) for argument in arguments])


def go_on(path, *options):
    cli.main(["train", "--resume", str(path), *map(str, options)])


def refused(capsys, command, *arguments) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        command(*arguments)
    assert exit.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("splatax: ")
    assert error.count("\n") == 1
    return error


QUICK = ("default",)  # it stands for the others, which `make slow` stops


@pytest.fixture(params=[pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in PRESETS])
def recipe(request, monkeypatch):
    """The name of a recipe, which is shortened so that it refines between the stops."""
    short = shortened(request.param)

    def make(steps=30, **_):
        return replace(short, steps=steps)

    preset = replace(PRESETS[request.param], build=make)
    monkeypatch.setitem(PRESETS, request.param, preset)
    return request.param


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory):
    """The folder of a run that was not stopped."""
    out = tmp_path_factory.mktemp("finished") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "keep_compiled_programs", lambda: None)
        start(capture, out)
    return out


@pytest.fixture(scope="module")
def cut(capture, tmp_path_factory):
    """The folder of a run that ended at step 13, with checkpoints of 5 and 10."""
    out = tmp_path_factory.mktemp("cut") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "keep_compiled_programs", lambda: None)
        patch.setattr(session, "optimize", ending_at(13))
        with pytest.raises(PowerCut):
            start(capture, out)
    return out


@pytest.fixture
def stopped(cut, tmp_path):
    """A copy of that folder."""
    return shutil.copytree(cut, tmp_path / "run")


@pytest.mark.slow
def test_a_run_with_refined_poses_that_was_stopped_ends_with_the_same_cameras(
    tmp_path, stopped_at, monkeypatch
):
    photos = write_capture(tmp_path / "photos", count=16)
    start(photos, tmp_path / "whole", "--refine", "poses")
    stopped_at(13)
    with pytest.raises(PowerCut):
        start(photos, tmp_path / "run", "--refine", "poses")
    monkeypatch.setattr(session, "optimize", sx.training.loop.optimize)
    go_on(tmp_path / "run")
    for name in ("scene.ply", "refined/sparse/0/images.bin"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def kept(run):
    return sorted(path.name for path in (run / "checkpoints").iterdir())


def test_a_run_that_was_stopped_again_and_again_ends_with_the_same_bytes(
    recipe, capture, tmp_path, stopped_at, monkeypatch
):
    options = ("--recipe", recipe, "--eval-every", "8", "--background", "random")
    start(capture, tmp_path / "whole", *options)
    stopped_at(9)
    with pytest.raises(PowerCut):
        start(capture, tmp_path / "run", *options)
    for stop in (10, 11, 23):
        stopped_at(stop)
        with pytest.raises(PowerCut):
            go_on(tmp_path / "run")
    monkeypatch.setattr(session, "optimize", sx.training.loop.optimize)
    go_on(tmp_path / "run")
    for name in ("scene.ply", "progress.gif", "held_out.json"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    whole, run = (json.loads((tmp_path / f / "metrics.json").read_text()) for f in ("whole", "run"))
    for key in ("test", "steps", "gaussians", "final_loss", "interrupted"):
        assert run[key] == whole[key]
    assert [(e["step"], e["psnr"]) for e in run["evaluations"]] == [
        (e["step"], e["psnr"]) for e in whole["evaluations"]
    ]
    assert whole["gaussians"] != 30  # it grew between the stops
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_saves_writes_the_results_and_says_how_to_go_on(
    capture, finished, tmp_path, monkeypatch, capsys, number
):
    def optimize(*arguments):
        for progress in sx.training.loop.optimize(*arguments):
            if progress.step == 7:
                os.kill(os.getpid(), number)
            yield progress

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(session, "optimize", optimize)
    start(capture, tmp_path / "run", "--checkpoint-every", "0", "--checkpoint-steps", "0")
    assert signal.getsignal(signal.SIGTERM) == before
    assert (
        f"stopped at step 7. Resume it: splatax train --resume {tmp_path / 'run'}" in capsys.readouterr().out
    )
    assert (tmp_path / "run" / "scene.ply").exists()
    assert kept(tmp_path / "run") == ["00000007.npz"]
    monkeypatch.setattr(session, "optimize", sx.training.loop.optimize)
    go_on(tmp_path / "run")
    assert "resuming after step 7 of 24" in capsys.readouterr().out
    assert (tmp_path / "run" / "scene.ply").read_bytes() == (finished / "scene.ply").read_bytes()
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["interrupted"] is False


def test_a_second_signal_stops_at_once(capture, tmp_path, monkeypatch):
    def optimize(*arguments):
        for progress in sx.training.loop.optimize(*arguments):
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            yield progress

    monkeypatch.setattr(session, "optimize", optimize)
    with pytest.raises(SystemExit) as exit:
        start(capture, tmp_path)
    assert exit.value.code == 130
    assert not (tmp_path / "scene.ply").exists()


# --- what is refused ---


def test_a_stopped_run_is_not_replaced_unless_told(stopped, capture, capsys):
    error = refused(capsys, start, capture, stopped)
    assert f"--resume {stopped}" in error
    assert "--overwrite" in error
    assert kept(stopped) == ["00000005.npz", "00000010.npz"]
    assert "--overwrite" in refused(capsys, cli.main, ["demo", "--out", str(stopped)])
    start(capture, stopped, "--overwrite")
    assert (stopped / "scene.ply").exists()


def test_nothing_to_go_on_with(capture, tmp_path, capsys, trained):
    assert "already finished" in refused(capsys, go_on, trained)
    assert "no such run" in refused(capsys, go_on, tmp_path / "nowhere")
    assert "stopped here before its first" in refused(capsys, go_on, tmp_path)
    (tmp_path / "scene.ply").write_bytes(b"")
    assert "no checkpoint" in refused(capsys, go_on, tmp_path / "scene.ply")
    assert "--resume" in refused(capsys, cli.main, ["train"])


def test_a_run_killed_before_its_first_checkpoint_can_be_started_again(
    capture, tmp_path, stopped_at, monkeypatch, capsys
):
    stopped_at(3)
    with pytest.raises(PowerCut):
        start(capture, tmp_path)
    assert "stopped here before its first" in refused(capsys, go_on, tmp_path)
    monkeypatch.setattr(session, "optimize", sx.training.loop.optimize)
    start(capture, tmp_path)


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_a_damaged_checkpoint_is_named_and_the_one_before_offered(stopped, finished, capsys, damage):
    newest, older = stopped / "checkpoints" / "00000010.npz", stopped / "checkpoints" / "00000005.npz"
    contents = bytearray(newest.read_bytes())
    contents[len(contents) // 2] ^= 4
    newest.write_bytes(contents if damage == "flipped" else contents[: len(contents) // 2])
    error = refused(capsys, go_on, stopped)
    assert f"{newest}: damaged" in error
    assert f"--resume {older}" in error
    older_contents = older.read_bytes()
    older.write_bytes(b"")
    assert "Start the run again" in refused(capsys, go_on, older)
    older.write_bytes(older_contents)
    go_on(older)
    assert (stopped / "scene.ply").read_bytes() == (finished / "scene.ply").read_bytes()


def test_other_options_are_refused_and_named(stopped, capsys, tmp_path):
    error = refused(capsys, go_on, stopped, "--steps", 30)
    assert "--steps 30: the run was started with 24" in error
    assert "--seed 1" in refused(capsys, go_on, stopped, "--seed", 1)
    assert "--out" in refused(capsys, go_on, stopped, "--out", tmp_path / "elsewhere")
    assert "--overwrite: the run was started without it" in refused(capsys, go_on, stopped, "--overwrite")
    go_on(stopped, "--steps", STEPS, "--checkpoint-steps", 2)  # the same, and what changes no scene


def test_a_capture_that_changed_is_refused(stopped, tmp_path, capsys):
    other = write_capture(tmp_path / "other", count=10)
    (other / "test.txt").write_text("photo04.png\nphoto05.png\n")
    error = refused(capsys, go_on, stopped, other)
    assert "the capture of the run changed: photos was 8 to train on and 1 held out, is 8 " in error
    wider = write_capture(tmp_path / "wider")
    points = wider / "sparse" / "0" / "points3D.bin"
    contents = bytearray(points.read_bytes())
    contents[20] ^= 1  # a coordinate of the first point, in its last bits
    points.write_bytes(contents)
    try:
        assert "the capture of the run changed: points was 30" in refused(capsys, go_on, stopped, wider)
    finally:
        assert kept(stopped) == ["00000005.npz", "00000010.npz"]


def test_photos_that_changed_are_named(stopped, tmp_path, capsys):
    other = write_capture(tmp_path / "other")
    (other / "masks").mkdir()
    for name in ("photo00.png", "photo01.png", "photo02.png", "photo03.png"):
        Image.new("L", (64, 48), 255).save(other / "masks" / name)
    error = refused(capsys, go_on, stopped, other)
    assert "changed: photo photo00.png was 64 x 48, is 64 x 48, with a mask; photo photo01.png was" in error
    assert "; and 1 more. Put it back" in error


def test_a_capture_that_has_moved_can_be_named(capture, stopped, tmp_path, capsys):
    capture.rename(tmp_path / "moved")
    try:
        error = refused(capsys, go_on, stopped)
    finally:
        (tmp_path / "moved").rename(capture)
    assert f"name its new folder: splatax train FOLDER --resume {stopped}" in error


def test_a_photo_that_fails_on_the_way_loses_no_step(capture, tmp_path, monkeypatch, capsys):
    def failing(*arguments):
        for progress in sx.training.loop.optimize(*arguments):
            yield progress
            if progress.step == 8:
                raise sx.errors.DatasetError("photo00.png: the photo is damaged.")

    run = tmp_path / "run"
    with monkeypatch.context() as broken:
        broken.setattr(session, "optimize", failing)
        error = refused(capsys, start, capture, run)
    assert "photo00.png: the photo is damaged. The run is saved after step 8." in error
    assert f"See --resume {run}" in error
    go_on(run)
    start(capture, tmp_path / "whole")
    assert (run / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()


def test_a_run_goes_on_after_its_folder_and_its_capture_moved(
    capture, finished, stopped, tmp_path, monkeypatch
):
    shutil.copytree(capture, tmp_path / "moved" / "noise")
    stopped.rename(tmp_path / "renamed")
    monkeypatch.chdir(tmp_path)
    go_on("renamed", "moved/noise")
    assert (tmp_path / "renamed" / "scene.ply").read_bytes() == (finished / "scene.ply").read_bytes()


def test_another_version_is_refused(stopped, monkeypatch, capsys):
    monkeypatch.setattr(resume, "versions", lambda: dict.fromkeys(DECISIVE, "0.0"))
    error = refused(capsys, go_on, stopped)
    ours = versions()["splatax"]
    assert f"the versions of the run changed: splatax was {ours}, is 0.0" in error


def test_another_recipe_behind_the_same_options_is_refused(stopped, monkeypatch, capsys):
    name = next(iter(PRESETS))
    chosen = json.loads(np.load(stopped / "checkpoints" / "00000010.npz")["header"].tobytes())
    assert chosen["run"]["options"]["recipe"] in PRESETS
    name = chosen["run"]["options"]["recipe"]
    preset = PRESETS[name]
    other = replace(preset, build=lambda **k: replace(preset.build(**k), sh=ShSchedule(every=77)))
    monkeypatch.setitem(PRESETS, name, other)
    assert "the recipe of the run changed: sh every was" in refused(capsys, go_on, stopped)


def test_another_machine_is_said(stopped, monkeypatch, capsys):
    monkeypatch.setattr(resume, "device", lambda: "an abacus")
    go_on(stopped)
    assert "this is an abacus: the result will be equivalent, but not the same bit for bit" in " ".join(
        capsys.readouterr().err.split()
    )


def test_a_full_disk_stops_training_in_words_and_the_run_goes_on_later(
    finished, stopped, monkeypatch, capsys
):
    fsync = os.fsync

    def full(descriptor):
        if "00000015" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("the system does not tell names of open files")
    monkeypatch.setattr(os, "fsync", full)
    error = refused(capsys, go_on, stopped)
    assert "No space left on device" in error
    assert "resume from 00000010.npz" in error
    assert kept(stopped) == ["00000005.npz", "00000010.npz"]
    monkeypatch.setattr(os, "fsync", fsync)
    go_on(stopped)
    assert (stopped / "scene.ply").read_bytes() == (finished / "scene.ply").read_bytes()


# --- whole processes ---


class Process:
    """The command line in a process of its own, in a group of its own."""

    def __init__(self, environment, *arguments, cpus=None):
        bound = f"import os; os.sched_setaffinity(0, {cpus}); " if cpus else ""
        self.popen = subprocess.Popen(
            [sys.executable, "-c", f"{bound}from splatax.cli import main; main()", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
        self.output = ""

    def read_until(self, beginning):
        """Reads lines up to one that begins like this; False if there is none."""
        for line in self.popen.stdout:
            self.output += line
            if line.startswith(beginning):
                return True
        return False

    def kill(self):
        """Kills it; returns whether it had ended before, which must have been well."""
        self.popen.kill()
        self.output += self.popen.stdout.read()
        code = self.popen.wait()
        assert code in (0, -signal.SIGKILL), self.output
        return code == 0

    def succeed(self):
        self.output += self.popen.communicate()[0]
        assert self.popen.returncode == 0, self.output


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Programs are compiled once for all processes."""
    return {**os.environ, "XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}


LONG = ("--steps", 500, "--checkpoint-steps", 10)


@pytest.fixture(scope="module")
def whole(capture, environment, tmp_path_factory):
    """The bytes of a scene that was trained without a stop."""
    out = tmp_path_factory.mktemp("whole")
    Process(environment, "train", capture, "--out", out, *LONG).succeed()
    return (out / "scene.ply").read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs signals of POSIX")
def test_killed_at_random_instants(capture, environment, whole, tmp_path):
    moments, ends = random.Random(0), 0
    run, started = tmp_path / "run", False
    for _ in range(8):
        arguments = ("--resume", run) if started else (capture, "--out", run, *LONG, "--overwrite")
        process = Process(environment, "train", *arguments)
        if process.read_until("step "):
            time.sleep(moments.uniform(0, 0.3))
        if process.kill() or (run / "scene.ply").exists():  # too late: the scene is written
            assert (run / "scene.ply").read_bytes() == whole
            shutil.rmtree(run)
            ends += 1
        started = bool(run.exists() and list((run / "checkpoints").glob("[0-9]*.npz")))
    if started:
        Process(environment, "train", "--resume", run).succeed()
        assert (run / "scene.ply").read_bytes() == whole
    assert ends < 4  # else it was rarely killed in time


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs signals of POSIX")
def test_killed_while_a_checkpoint_is_written(capture, environment, whole, tmp_path):
    caught = False
    for attempt in range(8):
        run = tmp_path / str(attempt)
        process = Process(environment, "train", capture, "--out", run, *LONG)
        deadline = time.monotonic() + 60
        while not list((run / "checkpoints").glob("[0-9]*.npz")) and time.monotonic() < deadline:
            time.sleep(0.001)
        while not list((run / "checkpoints").glob(".*.tmp")) and time.monotonic() < deadline:
            pass
        process.kill()
        if list((run / "checkpoints").glob(".*.tmp")):
            caught = True
            break
    assert caught
    Process(environment, "train", "--resume", run).succeed()
    assert (run / "scene.ply").read_bytes() == whole
    assert not (run / "checkpoints").exists()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not limit threads so")
def test_the_number_of_threads_changes_nothing(capture, environment, whole, tmp_path):
    one = {min(os.sched_getaffinity(0))}
    Process(environment, "train", capture, "--out", tmp_path, *LONG, cpus=one).succeed()
    assert (tmp_path / "scene.ply").read_bytes() == whole
