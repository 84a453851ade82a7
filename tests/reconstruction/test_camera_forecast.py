"""How long it takes to find cameras."""

import pytest
from rich.console import Console

from splatax.cli import reconstruct
from splatax.cli.reconstruct import FindingCameras, Forecasting
from splatax.cli.stages import Stages
from splatax.reconstruction import pipeline
from splatax.reconstruction.forecast import pairs_of, seconds_left
from splatax.reconstruction.pairs import Exhaustive, Sequential, Similar


def test_all_pairs_of_few_photos_are_matched_and_some_of_many():
    assert pairs_of(Exhaustive(), 20) == 190
    assert pairs_of(Similar(), 10) == pairs_of(Sequential(), 10) == 45
    assert 2000 < pairs_of(Similar(), 100) < 4950


def test_the_forecast_is_what_was_measured():
    """With smaller features, which took 11.7 s a photo: 173 s of matching, and 42 s after that."""
    assert seconds_left(11.7, 20, 20, Exhaustive()) == pytest.approx(173 + 42, rel=0.1)


def test_the_time_is_told_once_after_the_first_photos(tmp_path, capsys, monkeypatch):
    now = iter([0.0, 8.0])
    monkeypatch.setattr(reconstruct.time, "monotonic", lambda: next(now, 9.0))
    stages = Stages(pipeline.STAGES, Console(width=80))
    monkeypatch.setattr(stages, "show", lambda *_: None)
    watch = Forecasting(stages, tmp_path, FindingCameras())
    for stage, done in (("reading", 20), ("features", 0), ("features", 4), ("features", 20), ("matches", 0)):
        watch(stage, done, 20)
    left = 2 * 16 + 0.076 * 2 * 190 + 2.5 * 20
    assert capsys.readouterr().out == f"the cameras of 20 photos take about 1:{left - 60:.0f} min more\n"
