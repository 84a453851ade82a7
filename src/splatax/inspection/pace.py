"""Estimates the training time on this machine from a few measured steps."""

import time

from splatax import backends
from splatax.bench.operations import step
from splatax.bench.scenes import procedural
from splatax.bench.timing import timed
from splatax.dataset import Dataset
from splatax.runs.budget import HEAVIER, coarse_size, mean_count
from splatax.training.recipes import COARSE, Recipe, default

TIMED, ROUNDS = 1.0, 10  # seconds for which steps of one size are timed; most steps


def seconds_to_train(dataset: Dataset, gaussians: int) -> float:
    """Returns the time of all steps of the recipe `default` if nothing else runs. It takes some seconds.

    Two programs are compiled and timed: one for the steps with smaller photos, and one for the rest. Both use
    the mean number of Gaussians, because the time of a step is linear in it. Loading, evaluation and
    compilation of other programs are not included.

    Args:
        dataset: the capture.
        gaussians: number of Gaussians that the scene grows to.
    """
    recipe = default(max_gaussians=gaussians).on(backends.resolve("auto"))
    camera = dataset.train[0].camera
    size = camera.width, camera.height
    fewer = round(mean_count(min(len(dataset.points) or gaussians, gaussians), gaussians))
    coarse = seconds_a_step(fewer, coarse_size(size, recipe), recipe)
    fine = seconds_a_step(gaussians, size, recipe)
    return HEAVIER * recipe.steps * (coarse + (COARSE - 1) * fine) / COARSE


def seconds_a_step(gaussians: int, size: tuple[int, int], recipe: Recipe) -> float:
    """Returns the shortest of several measured times of a training step."""
    work = step(procedural(gaussians, size), recipe)
    timed(work)  # compiles
    end, times = time.monotonic() + TIMED, [timed(work), timed(work)]
    while time.monotonic() < end and len(times) < ROUNDS:
        times.append(timed(work))
    return min(times) / 1e3
