"""The output of a run where there is no terminal."""

import io

import pytest
from rich.console import Console

from splatax.cli.display import Display
from splatax.runs.budget import duration


@pytest.mark.parametrize(
    ("seconds", "words"), [(45.4, "45 s"), (60.0, "1:00 min"), (3599.0, "59:59 min"), (3661.0, "1:01:01 h")]
)
def test_durations_read_like_a_clock(seconds, words):
    assert duration(seconds) == words


def test_lines_tell_step_loss_count_and_the_time_left(monkeypatch):
    clock = iter([0.0, 2.0, 12.0, 22.0])
    monkeypatch.setattr("splatax.cli.display.time.monotonic", lambda: next(clock))
    output = io.StringIO()
    with Display(40, Console(file=output, width=200)) as display:
        display.announce("compiling")
        display.step(1, 0.5, 1000)  # at 0 s: the first of all is not shown, nothing is known yet
        display.step(2, 0.4, 1000)  # too soon after
        display.psnr = 21.5
        display.step(11, 0.25, 2000)
        display.step(21, 0.125, 3000)
    lines = output.getvalue().splitlines()
    assert lines[0] == "compiling ..."
    assert lines[-1] == ("step 21 of 40  loss 0.1250  3,000 Gaussians  test 21.50 dB  0.9 steps/s  ETA 21 s")
