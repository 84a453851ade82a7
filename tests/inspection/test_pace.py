"""The forecast of the run that `splatax train` plans without options."""

from dataclasses import replace

import numpy as np
import pytest

import splatax as sx
from captures import write_capture
from splatax.cli.planning import planned_by_time
from splatax.cli.settings import Settings
from splatax.dataset import PointCloud
from splatax.inspection import examine, forecasted
from splatax.inspection.examination import memory_for
from splatax.report.capture import facts_of, roughly
from splatax.runs.budget import DEFAULT_BUDGET, MOST_VISITS, Cost, Costs
from splatax.runs.planning import Room
from splatax.training.recipes import room_for


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "capture", count=24)


@pytest.mark.parametrize("milliseconds", [1, 500])
def test_the_forecast_is_of_the_run_that_train_plans_without_options(capture, milliseconds, monkeypatch):
    cost = Cost(milliseconds / 1e3, 0.0)
    monkeypatch.setattr("splatax.inspection.pace.measured", lambda *_: Costs(cost, cost))
    monkeypatch.setattr("splatax.cli.planning.measured", lambda *_: Costs(cost, cost))
    dataset = sx.load_dataset(capture)
    found = forecasted(examine(capture, dataset))
    settings = Settings(scene=capture, budget=DEFAULT_BUDGET)
    planned, *_ = planned_by_time(settings, dataset, Room(), room_for(dataset), None)
    assert (found.steps, found.gaussians) == (planned.steps, planned.max_gaussians)
    assert found.steps == (MOST_VISITS * len(dataset.train) if milliseconds == 1 else 707)
    assert found.memory == memory_for(dataset, found.gaussians)
    (said,) = (value for label, value in facts_of(found) if label == "time to train")
    assert said.startswith(f"about {roughly(found.seconds)} by default: {found.steps:,} steps to ")


def test_the_forecast_of_a_capture_without_points_is_that_of_a_random_start(capture, monkeypatch):
    monkeypatch.setattr("splatax.inspection.pace.measured", lambda *_: Costs(Cost(0.1, 0.0), Cost(0.1, 0.0)))
    dataset = sx.load_dataset(capture)
    nothing = PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.float32))
    found = forecasted(examine(capture, replace(dataset, points=nothing)))
    assert found.seconds == pytest.approx(360, rel=0.01)
