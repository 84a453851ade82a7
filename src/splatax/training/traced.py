"""The settings of a recipe that the program of a training step is traced with."""

from dataclasses import replace
from functools import lru_cache

from splatax.training.density import Classic, Mcmc, Splitting
from splatax.training.optimizer import LearningRates
from splatax.training.protocols import DensityStrategy
from splatax.training.recipes import Recipe


@lru_cache(maxsize=16)
def of_a_step(recipe: Recipe) -> Recipe:
    """Returns a recipe with the defaults of all settings that a step gets as inputs or does not use.

    `jit` traces and compiles a step for each recipe that it has not seen. Runs that differ in their number of
    steps, their seed or their number of Gaussians, such as the trial and the run of `splatax create`, share
    one program. That program must use no setting that is left out here: it would find the default.

    Raises:
        ValueError: if the recipe names its backend, instead of holding the kernels.
    """
    return Recipe(
        objective=recipe.objective,
        optimizer=replace(recipe.optimizer, rates=LearningRates()),
        density=of_a_view(recipe.density),
        appearance=recipe.appearance,
        camera_refinement=recipe.camera_refinement,
        drawing=replace(recipe.drawing, backend=recipe.drawing.kernels),
    )


def of_a_view(density: DensityStrategy) -> DensityStrategy:
    """Returns a strategy with the defaults of all settings that `watch` and `observe` do not use."""
    if type(density) is Classic:
        return Classic(absolute=density.absolute)
    return type(density)() if type(density) in (Mcmc, Splitting) else density
