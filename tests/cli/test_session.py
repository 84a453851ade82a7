"""Training sessions as the command line uses them."""

import os
import signal

import splatax as sx
from splatax import cli
from splatax.runs import session


def press_ctrl_c_at(step):
    """`optimize`, with a user who presses Ctrl-C while a step is made."""

    def optimize(*arguments):
        for progress in sx.training.loop.optimize(*arguments):
            if progress.step == step:
                os.kill(os.getpid(), signal.SIGINT)
            yield progress

    return optimize


def test_ctrl_c_keeps_what_has_been_reached(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(session, "optimize", press_ctrl_c_at(3))
    before = signal.getsignal(signal.SIGINT)
    cli.main(["train", str(capture), "--out", str(tmp_path), "--steps", "100"])
    assert signal.getsignal(signal.SIGINT) == before
    assert len(sx.load(tmp_path / "scene.ply")) == 30
    assert '"interrupted": true' in (tmp_path / "metrics.json").read_text()
    assert '"steps": 3,' in (tmp_path / "metrics.json").read_text()
    assert "interrupted" in (tmp_path / "report.html").read_text()
