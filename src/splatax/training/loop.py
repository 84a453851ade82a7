"""Training as a generator: progress bars, evaluation and viewers are `for` loops over it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax import rasterizers
from splatax.dataset import Dataset
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.training import optimizer
from splatax.training.capacity import bucket_for, pad
from splatax.training.feed import batches
from splatax.training.recipes import Recipe
from splatax.training.step import TrainState, train_step


@dataclass(frozen=True)
class Progress:
    """What `optimize` yields after each step.

    Attributes:
        step: how many have been made, from 1.
        loss: of the step's view; reading it waits for the step to end.
        count: of Gaussians.
    """

    step: int
    loss: Float[Array, ""]
    count: int
    _state: TrainState

    @property
    def gaussians(self) -> Gaussians:
        """A copy of the scene as it is now. The next step uses up what it is copied from, so take
        it before, or keep the last one."""
        return jax.tree.map(lambda leaf: jnp.array(leaf[: self.count]), self._state.gaussians)

    @property
    def padded(self) -> Gaussians:
        """The same scene with its empty slots, valid until the next step. To look at a scene that
        grows, render this: its shape, and with it the compiled program, changes rarely."""
        return self._state.gaussians


def fit(dataset: Dataset, recipe: Recipe) -> Gaussians:
    """Trains a scene to the end; see `optimize`."""
    for progress in optimize(dataset, recipe):
        pass
    return progress.gaussians


def optimize(dataset: Dataset, recipe: Recipe) -> Iterator[Progress]:
    """Trains a scene, and yields after each step. The same arguments give the same scene.

    Raises:
        DatasetError: if there are no training views, or nothing to start from.
        ValueError: if the recipe has no steps, or its backend is not available.
    """
    if not dataset.train:
        raise DatasetError("The capture has no photos to train on.")
    if recipe.steps < 1:
        raise ValueError(f"a recipe needs at least one step, not {recipe.steps}")
    recipe = replace(recipe, backend=rasterizers.resolve(recipe.backend))
    gaussians = recipe.initialization(dataset, recipe.sh_degree, recipe.seed)
    yield from _steps(dataset, recipe, gaussians)


def _steps(dataset: Dataset, recipe: Recipe, gaussians: Gaussians) -> Iterator[Progress]:
    count = len(gaussians)
    capacity = bucket_for(count)
    padded = pad(gaussians, capacity)
    key, refine_key = jax.random.split(jax.random.key(recipe.seed))
    state = TrainState(
        step=jnp.int32(0),
        gaussians=padded,
        opt_state=optimizer.ADAM.init(padded),
        density_state=recipe.density.init(capacity),
        key=key,
        extent=jnp.float32(dataset.extent),
    )
    for step, batch in zip(range(1, recipe.steps + 1), batches(dataset.train, recipe.seed), strict=False):
        state, loss = train_step(state, batch, recipe)
        if recipe.density.due(step):
            refined = recipe.density.refine(
                state.density_state,
                state.gaussians,
                count,
                step,
                dataset.extent,
                jax.random.fold_in(refine_key, step),
            )
            count = refined.count
            state = replace(
                state,
                gaussians=refined.gaussians,
                opt_state=optimizer.inherit(state.opt_state, refined.lineage),
                density_state=refined.state,
            )
        yield Progress(step, loss, count, state)
