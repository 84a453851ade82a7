"""Job files of docs/jobs: they start a run, continue it, and leave a finished one alone."""

import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from splatax import cli
from splatax.cli.blocks import TrainBlock
from splatax.cli.train import Train

JOBS = Path(__file__).parents[2] / "docs" / "jobs"
OPTIONS = "--steps 30000 --views 64"


def started(tmp_path, run):
    """The command that train.sh runs, its words; and what it prints."""
    fake = tmp_path / "bin" / "splatax"
    fake.parent.mkdir(exist_ok=True)
    fake.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path}/words\n')
    fake.chmod(0o755)
    variables = {"CAPTURE": "city", "RUN": str(run), "HOSTS": "10.0.0.1:8476,8,3", "OPTIONS": OPTIONS}
    path = f"{fake.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", JOBS / "train.sh"],
        env={**variables, "PATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    words = tmp_path / "words"
    return words.read_text().split("\n")[:-1] if words.exists() else [], done.stdout


def understood(words, monkeypatch):
    """The options of `splatax train` as the command line reads them."""
    commands = []
    monkeypatch.setattr(Train, "run", lambda command: commands.append(command))
    cli.main(words)
    (command,) = commands
    return command


def test_a_job_starts_a_run_continues_it_and_leaves_a_finished_one_alone(tmp_path, monkeypatch):
    run = tmp_path / "run"
    words, _ = started(tmp_path, run)
    new = understood(words, monkeypatch)
    assert (str(new.scene), new.out, new.limits.steps) == ("city", run, 30_000)
    assert (new.devices.views, new.devices.hosts) == (64, "10.0.0.1:8476,8,3")
    (run / "checkpoints").mkdir(parents=True)
    assert started(tmp_path, run)[0] == words, "without a checkpoint there is nothing to continue"
    (run / "checkpoints" / "00000500.npz").touch()
    (run / "scene.ply").touch()  # of the stopped run
    resumed = understood(started(tmp_path, run)[0], monkeypatch)
    assert (resumed.rerun.resume, resumed.devices.hosts) == (run, "10.0.0.1:8476,8,3")
    (run / "checkpoints" / "00000500.npz").unlink()
    (tmp_path / "words").unlink()
    assert started(tmp_path, run) == ([], f"{run}: holds a finished run\n")


@pytest.mark.parametrize("name", ["jobset.yaml", "skypilot.yaml", "slurm.sh"])
def test_job_files_name_what_the_job_needs(name):
    text = (JOBS / name).read_text()
    if name.endswith(".sh"):
        subprocess.run(["bash", "-n", JOBS / name], check=True)
    else:
        assert yaml.safe_load(text)
    assert "train.sh" in text
    assert all(re.search(rf"\b{variable}\b", text) for variable in ("CAPTURE", "RUN", "HOSTS", "OPTIONS"))
    assert OPTIONS in text


def test_the_pods_of_a_jobset_find_the_first_of_them():
    jobset = yaml.safe_load((JOBS / "jobset.yaml").read_text())
    (job,) = jobset["spec"]["replicatedJobs"]
    spec, name = job["template"]["spec"], jobset["metadata"]["name"]
    (container,) = spec["template"]["spec"]["containers"]
    first = f"{name}-{job['name']}-0-0.{name}"
    (port,) = (each["containerPort"] for each in container["ports"])
    assert spec["parallelism"] == spec["completions"]
    assert f"{first}:{port},{spec['completions']},$JOB_COMPLETION_INDEX" in container["args"][0]


@pytest.mark.parametrize("name", ["blocks.sh", "blocks.yaml"])
def test_jobs_of_blocks_train_the_block_that_their_variables_name(name, tmp_path, monkeypatch):
    variables = {"CITY": str(tmp_path), "BLOCK": "3", "SLURM_ARRAY_TASK_ID": "3"}
    script = JOBS / name
    if name.endswith(".yaml"):
        task = yaml.safe_load(script.read_text())
        assert task["envs"].keys() == {"CITY", "BLOCK"}
        script = tmp_path / "run.sh"
        script.write_text(task["run"])
    fake = tmp_path / "bin" / "splatax"
    fake.parent.mkdir()
    fake.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path}/words\n')
    fake.chmod(0o755)
    path = f"{fake.parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(["bash", script], env={**variables, "PATH": path}, check=True)
    commands = []
    monkeypatch.setattr(TrainBlock, "run", lambda command: commands.append(command))
    cli.main((tmp_path / "words").read_text().split("\n")[:-1])
    assert [(command.city, command.block) for command in commands] == [(tmp_path, 3)]
