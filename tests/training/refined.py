"""A refinement of a scene on one device, as the training loop makes it."""

from typing import Any, NamedTuple

import numpy as np

import splatax as sx
from splatax.training.optimizer import Adam
from splatax.training.refining import Due, Kept, on_one_device, planned, rows_after


class Refined(NamedTuple):
    """A refined scene, and its plan by row of living Gaussians."""

    gaussians: sx.Gaussians
    count: int
    parents: np.ndarray
    newborn: np.ndarray
    restarted: tuple[str, ...]
    kept: Kept


def refine(strategy: Any, state: Any, gaussians: sx.Gaussians, count: int, due: Due) -> Refined:
    """Refines a scene of `count` living Gaussians with statistics of its strategy."""
    recipe = sx.Recipe(density=strategy)
    plan = planned(strategy.columns(state, gaussians), count, due, recipe)
    before = Kept(gaussians, Adam()().init(gaussians), state)
    kept = on_one_device(before, plan, rows_after(plan, len(gaussians)), recipe)
    return Refined(kept.gaussians, plan.count, plan.parents, plan.newborn, plan.restarted, kept)
