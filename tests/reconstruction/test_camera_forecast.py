"""The forecast of the time that finding cameras takes."""

import pytest
from rich.console import Console

from splatax.cli import reconstruct
from splatax.cli.reconstruct import FindingCameras, Forecasting
from splatax.cli.stages import Stages
from splatax.reconstruction import pipeline
from splatax.reconstruction.forecast import pairs_of, seconds_left
from splatax.reconstruction.pairs import Exhaustive, Sequential, Similar
from splatax.runs.budget import duration


def test_all_pairs_of_few_photos_are_matched_and_some_of_many():
    assert pairs_of(Exhaustive(), 20) == 190
    assert pairs_of(Similar(), 10) == pairs_of(Sequential(), 10) == 45
    assert 2000 < pairs_of(Similar(), 100) < 4950


def test_the_forecast_is_what_was_measured():
    """With smaller features, which took 11.7 s a photo: 173 s of matching, and 42 s after that."""
    assert seconds_left(11.7, 20, 20, Exhaustive(), 20) == pytest.approx(173 + 42, rel=0.1)


@pytest.mark.parametrize(("photos", "pictures"), [(20, 20), (4, 24)])  # 4 are of 360 degrees, in 6 faces
def test_the_time_is_told_once_after_the_first_photos(tmp_path, capsys, monkeypatch, photos, pictures):
    now = iter([0.0, 8.0])
    monkeypatch.setattr(reconstruct.time, "monotonic", lambda: next(now, 9.0))
    stages = Stages(pipeline.STAGES, Console(width=80))
    monkeypatch.setattr(stages, "show", lambda *_: None)
    watch = Forecasting(stages, tmp_path, FindingCameras())
    watch("reading", photos, photos)
    for stage, done in (("features", 0), ("features", 4), ("features", pictures), ("matches", 0)):
        watch(stage, done, pictures)
    pairs = pictures * (pictures - 1) / 2
    left = 2 * (pictures - 4) + 0.076 * 2 * pairs + 2.5 * photos
    expected = f"the cameras of {photos} photos take about {duration(left)} more\n"
    assert capsys.readouterr().out == expected
