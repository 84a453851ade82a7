"""Output to the terminal, and commands whose output cannot be written."""

import ast
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import splatax as sx
from splatax import cli
from splatax.cli import evaluate, output
from splatax.cli.output import UNWRITTEN, printable

HOSTILE = "a\x1b]0;pwn\x07\u202eb\nc.png"


def test_control_characters_of_names_are_shown_and_not_obeyed():
    assert printable(HOSTILE) == "a\\x1b]0;pwn\\x07\\u202eb\\nc.png"
    assert (
        printable("Ausflug \u00fc \u65e5\u672c \U0001f600.jpg")
        == "Ausflug \u00fc \u65e5\u672c \U0001f600.jpg"
    )
    assert printable("latin-1 \udcfc") == "latin-1 \\udcfc"


def test_a_hostile_photo_name_in_a_table_of_scores_and_in_an_error(
    trained, capture, monkeypatch, capsys, tmp_path
):
    dataset = sx.load_dataset(capture)
    views = tuple(replace(view, name=HOSTILE) for view in dataset.test)
    monkeypatch.setattr(evaluate, "load_scene", lambda *_: replace(dataset, test=views))
    cli.main(["eval", str(trained), str(capture), "--out", str(tmp_path / "scores.json")])
    printed = capsys.readouterr().out
    assert "\\x1b]0;pwn\\x07" in printed
    assert not {"\x1b", "\x07", "\u202e"} & set(printed)
    with pytest.raises(SystemExit):
        cli.main(["eval", str(tmp_path / HOSTILE), str(capture)])
    error = capsys.readouterr().err
    assert "\\x1b]0;pwn" in error
    assert error.count("\n") == 1


def test_commands_print_through_one_place():
    for path in sorted(Path(cli.__file__).parent.glob("*.py")):
        calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        printing = [call for call in calls if isinstance(call, ast.Name) and call.id == "print"]
        assert path.name == Path(output.__file__).name or not printing, f"{path.name} prints by itself"


@pytest.fixture
def closed_pipe():
    """Where output goes after `| head -1` has read its line."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w", buffering=1) as stream:
        yield stream


def test_a_closed_pipe_loses_no_training(closed_pipe, capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", closed_pipe)
    cli.main(["train", str(capture), "--out", str(tmp_path / "run"), "--steps", "2"])
    assert (tmp_path / "run" / "report.html").exists()
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no full device")
def test_a_full_disk_behind_standard_output_loses_no_training_and_is_told(
    capture, tmp_path, monkeypatch, capsys
):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        with pytest.raises(SystemExit) as exit:
            cli.main(["train", str(capture), "--out", str(tmp_path / "run"), "--steps", "2"])
    assert exit.value.code == UNWRITTEN
    assert (tmp_path / "run" / "report.html").exists()
    error = capsys.readouterr().err
    assert error.startswith("splatax: standard output: No space left on device.")
    assert error.count("\n") == 1


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no full device")
def test_help_into_a_full_disk_ends_in_a_sentence():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "splatax", "--help"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == UNWRITTEN
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("splatax: standard output:")
