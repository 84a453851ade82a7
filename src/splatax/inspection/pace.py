"""How long training would take here, from a few measured steps."""

import time
from dataclasses import replace

from splatax import backends
from splatax.bench.operations import step
from splatax.bench.scenes import procedural
from splatax.bench.timing import timed
from splatax.dataset import Dataset
from splatax.runs.budget import HEAVIER, coarse_size, mean_count
from splatax.training.recipes import COARSE, Recipe, default

TIMED, ROUNDS = 1.0, 10  # seconds that steps of a size are timed for; and the most of them


def seconds_to_train(dataset: Dataset, gaussians: int) -> float:
    """Of all steps of the recipe `default`, if nothing else runs. Takes some seconds.

    Two programs are compiled and timed, for the part with smaller photos and for the rest, with as many
    Gaussians as there are in the mean: steps are linear in them. Loading, evaluations and other programs
    are not counted.

    Args:
        dataset: the capture.
        gaussians: that the scene grows to.
    """
    recipe = replace(default(max_gaussians=gaussians), backend=backends.resolve("auto"))
    camera = dataset.train[0].camera
    size = camera.width, camera.height
    fewer = round(mean_count(min(len(dataset.points) or gaussians, gaussians), gaussians))
    coarse = seconds_a_step(fewer, coarse_size(size, recipe), recipe)
    fine = seconds_a_step(gaussians, size, recipe)
    return HEAVIER * recipe.steps * (coarse + (COARSE - 1) * fine) / COARSE


def seconds_a_step(gaussians: int, size: tuple[int, int], recipe: Recipe) -> float:
    """The shortest of some."""
    work = step(procedural(gaussians, size), recipe)
    timed(work)  # compiles
    end, times = time.monotonic() + TIMED, [timed(work), timed(work)]
    while time.monotonic() < end and len(times) < ROUNDS:
        times.append(timed(work))
    return min(times) / 1e3
