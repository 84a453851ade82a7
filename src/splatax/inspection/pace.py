"""How long training would take here, from a few measured steps."""

import time
from dataclasses import replace

from splatax import rasterizers
from splatax.bench.operations import step
from splatax.bench.scenes import procedural
from splatax.bench.timing import timed
from splatax.budget import HEAVIER, mean_count
from splatax.dataset import Dataset
from splatax.training.recipes import default

TIMED, ROUNDS = 1.0, 10  # seconds that steps are timed for, after the first two; and the most of them


def seconds_to_train(dataset: Dataset, gaussians: int) -> float:
    """Of all steps of the recipe `default`, if nothing else runs. Takes some seconds.

    One program is compiled and timed, for a scene of as many Gaussians as a run has in the mean: steps
    are linear in them. Loading, evaluations and other programs are not counted.

    Args:
        dataset: the capture.
        gaussians: that the scene grows to.
    """
    recipe = replace(default(max_gaussians=gaussians), backend=rasterizers.resolve("auto"))
    camera = dataset.train[0].camera
    count = round(mean_count(min(len(dataset.points) or gaussians, gaussians), gaussians))
    work = step(procedural(count, (camera.width, camera.height)), recipe)
    timed(work)  # compiles
    end, times = time.monotonic() + TIMED, [timed(work), timed(work)]
    while time.monotonic() < end and len(times) < ROUNDS:
        times.append(timed(work))
    return HEAVIER * min(times) / 1e3 * recipe.steps
