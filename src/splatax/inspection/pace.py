"""Forecasts a training run with default options on this machine, from a few measured steps."""

from dataclasses import replace

from splatax.inspection.examination import Examination, memory_for
from splatax.runs.budget import DEFAULT_BUDGET, bounds_of, measured, parse_seconds, plan
from splatax.runs.planning import room_within
from splatax.training.recipes import PRESETS, default, room_for


def forecasted(found: Examination) -> Examination:
    """Returns measurements with a forecast of the run that `splatax train` plans without options.

    It times steps for some seconds. Loading, evaluation and scores are not included.

    Args:
        found: measurements of a capture with poses.
    """
    assert found.dataset is not None
    dataset, recipe = found.dataset, default()
    most, camera = room_for(dataset), dataset.train[0].camera
    costs = measured((camera.width, camera.height), recipe, camera.lens)
    start = recipe.initialization if len(dataset.points) else PRESETS["default"].random_start
    first = start.number(dataset)
    bounds = bounds_of(len(dataset.train), most, room_within(None, dataset, first).gaussians)
    run = plan(costs, parse_seconds(DEFAULT_BUDGET), first, bounds)
    return replace(
        found,
        gaussians=run.max_gaussians,
        memory=memory_for(dataset, run.max_gaussians),
        steps=run.steps,
        seconds=costs.run(run.steps, min(first, run.max_gaussians), run.max_gaussians),
    )
