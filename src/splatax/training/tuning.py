"""Tuning of a finished scene, such as one that was simplified: training with a fixed number of Gaussians."""

from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp

from splatax.dataset import Dataset
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.training.backgrounds import Solid
from splatax.training.capacity import bucket_for, pad
from splatax.training.density.none import NoDensityControl
from splatax.training.drawing import Drawing
from splatax.training.feed import rows_for
from splatax.training.loop import Progress, RunState, first_state, optimize
from splatax.training.recipes import Objective, Recipe, ShSchedule, default
from splatax.training.resolution import Resolution

STEPS = 1000  # half as many lose 0.3 to 0.5 dB on the demo; see docs/formats.md


def tuning(gaussians: Gaussians, steps: int = STEPS, background: Solid = Solid()) -> Recipe:
    """Returns the recipe `default` without density control, half-size photos and prior.

    Args:
        gaussians: the scene; its harmonics, its low-pass filter and its order are kept.
        steps: number of steps.
        background: behind the scene.
    """
    recipe = default(steps=steps)
    return replace(
        recipe,
        objective=Objective(),
        density=NoDensityControl(),
        resolution=Resolution(),
        sh=ShSchedule(degree=harmonics.degree_of(gaussians.sh.shape[1]), every=1),
        drawing=Drawing(background, gaussians.low_pass).in_order(gaussians.order),
    )


def tune(gaussians: Gaussians, dataset: Dataset, recipe: Recipe) -> Iterator[Progress]:
    """Trains a scene further on the training photos of a capture, and yields after each step.

    Args:
        gaussians: the scene. It is not changed.
        dataset: its capture.
        recipe: such as `tuning` returns.
    """
    count = len(gaussians)
    # During training the recipe holds the filter and the order, and scenes have the default ones.
    copied = replace(jax.tree.map(jnp.array, gaussians), low_pass=Gaussians.low_pass, order=Gaussians.order)
    padded = pad(copied, bucket_for(count))
    state = first_state(padded, recipe, dataset.extent, rows_for(dataset.train))
    yield from optimize(dataset, recipe, RunState(state, count))
