"""Runs that are repeated from their config.json."""

import json

import pytest

from splatax import cli


@pytest.fixture
def run(capture, tmp_path):
    """The folder of a finished run."""
    cli.main(["train", str(capture), "--out", str(tmp_path / "run"), "--steps", "12"])
    return tmp_path / "run"


def test_a_repeated_run_has_the_same_bytes(run, tmp_path):
    cli.main(["train", "--repeat", str(run), "--out", str(tmp_path / "again")])
    assert (tmp_path / "again" / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()


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
