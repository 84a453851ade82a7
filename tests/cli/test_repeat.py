"""Runs that are repeated from their config.json."""

import json

import pytest

import splatax as sx
from splatax import cli


@pytest.fixture
def run(capture, tmp_path):
    """The folder of a finished run."""
    cli.main(["train", str(capture), "--out", str(tmp_path / "run"), "--steps", "12"])
    return tmp_path / "run"


def test_a_repeated_run_has_the_same_bytes(run, tmp_path, capsys):
    cli.main(["train", "--repeat", str(run), "--out", str(tmp_path / "again")])
    assert "warning" not in capsys.readouterr().err
    assert (tmp_path / "again" / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()


def test_a_run_of_another_version_is_repeated_with_a_warning(run, tmp_path, capsys):
    config = json.loads((run / "config.json").read_text())
    assert config["versions"]["splatax"] == sx.__version__
    config["versions"] |= {"splatax": "0.1.0", "python": "3.9"}
    (run / "config.json").write_text(json.dumps(config))
    cli.main(["train", "--repeat", str(run), "--out", str(tmp_path / "again")])
    told = f"warning: the scene may not have the same bytes: splatax was 0.1.0, is {sx.__version__}\n"
    assert capsys.readouterr().err == f"splatax: {told}"


def refused(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as exit:
        cli.main(["train", *map(str, arguments)])
    assert exit.value.code == 2
    return capsys.readouterr().err


def test_a_run_that_was_stopped_early_is_not_repeated(run, tmp_path, capsys):
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | {"interrupted": True}))
    error = refused(capsys, "--repeat", run, "--out", tmp_path / "again")
    assert f"{run}: this run was stopped early" in error
    assert f"See --resume {run}" in error
    assert not (tmp_path / "again").exists()


def test_a_run_is_either_resumed_or_repeated(run, capsys):
    assert "Give one of them" in refused(capsys, "--resume", run, "--repeat", run)


def test_what_is_no_run_is_not_repeated(run, tmp_path, capsys):
    assert "scene.ply: not the settings of a run" in refused(capsys, "--repeat", run / "scene.ply")
    assert "nope: no such run" in refused(capsys, "--repeat", tmp_path / "nope")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda config: config["options"].pop("seed"), "other options (seed)"),
        (lambda config: config["options"].update(speed=3), "other options (speed)"),
        (lambda config: config.pop("changes"), "no 'changes' in it"),
        (lambda config: config.pop("options"), "damaged"),
    ],
)
def test_a_config_that_does_not_fit_is_refused_with_what_is_wrong(run, change, complaint, capsys):
    config = json.loads((run / "config.json").read_text())
    change(config)
    (run / "config.json").write_text(json.dumps(config))
    with pytest.raises(SystemExit) as exit:
        cli.main(["train", "--repeat", str(run)])
    assert exit.value.code == 2
    assert complaint in capsys.readouterr().err
