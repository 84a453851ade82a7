"""Training as a generator: progress bars, evaluation and viewers are `for` loops over it."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from splatax import backends
from splatax.dataset import Dataset
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.training.capacity import bucket_for, pad, without_broken
from splatax.training.feed import batches
from splatax.training.initialize import require_visible
from splatax.training.optimizer import inherit
from splatax.training.recipes import Recipe
from splatax.training.step import Faults, TrainState, train_step


@dataclass(frozen=True)
class RunState:
    """A run between two steps: with the data set and the recipe, all that is needed to go on.

    Attributes:
        train: what the steps change. The next step uses it up.
        count: of living Gaussians.
    """

    train: TrainState
    count: int


@dataclass(frozen=True)
class Progress:
    """What `optimize` yields after each step.

    Attributes:
        step: how many have been made, from 1.
        total: how many there will be, as planned now.
        loss: of the step's view; reading it waits for the step to end.
        count: of Gaussians.
    """

    step: int
    total: int
    loss: Float[Array, ""]
    count: int
    _state: TrainState

    @property
    def state(self) -> RunState:
        """What `optimize` needs to go on from here, valid until the next step."""
        return RunState(self._state, self.count)

    @property
    def faults(self) -> Faults:
        """What was not finite until now, valid until the next step."""
        return self._state.faults

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


def optimize(
    dataset: Dataset,
    recipe: Recipe,
    start: RunState | None = None,
    pace: Callable[[int], int | None] | None = None,
    photo_room: int | float = math.inf,
) -> Iterator[Progress]:
    """Trains a scene, and yields after each step. The same arguments give the same scene.

    Args:
        dataset: the capture.
        recipe: how.
        start: a run of the same data set and recipe, to go on as if it had never stopped. It is used up.
        pace: asked after each step, once it has been yielded; may say how many steps the run shall have
            from now on instead of the recipe's.
        photo_room: bytes of memory for decoded photos; those that do not fit are read for each step.

    Raises:
        DatasetError: if there are no training views, or nothing to start from that they see.
        ValueError: if the recipe has no steps, none are left, or its backend is not available.
    """
    if not dataset.train:
        raise DatasetError("The capture has no photos to train on.")
    if recipe.steps < 1:
        raise ValueError(f"a recipe needs at least one step, not {recipe.steps}")
    recipe = replace(recipe, backend=backends.resolve(recipe.backend))
    if start is None:
        gaussians = recipe.initialization(dataset, recipe.sh.degree, recipe.seed)
        require_visible(gaussians, dataset)
        padded = pad(gaussians, bucket_for(len(gaussians)))
        start = RunState(first_state(padded, recipe, dataset.extent, len(dataset.train)), len(gaussians))
    yield from _steps(dataset, recipe, start, pace or (lambda step: None), photo_room)


def first_state(gaussians: Gaussians, recipe: Recipe, extent: float, photos: int) -> TrainState:
    """Before any step, from a padded scene and so many photos."""
    key, _ = _keys(recipe)
    return TrainState(
        step=jnp.int32(0),
        total=jnp.int32(recipe.steps),
        gaussians=gaussians,
        opt_state=recipe.optimizer.rule().init(gaussians),
        density_state=recipe.density.init(len(gaussians)),
        appearance=recipe.appearance.init(photos),
        cameras=recipe.camera_refinement.init(photos),
        key=key,
        extent=jnp.float32(extent),
        faults=Faults(jnp.int32(0), jnp.int32(0)),
    )


def _keys(recipe: Recipe) -> tuple[PRNGKeyArray, PRNGKeyArray]:
    """Of the steps and of the refinements."""
    key, refine_key = jax.random.split(jax.random.key(recipe.seed))
    return key, refine_key


def _steps(
    dataset: Dataset,
    recipe: Recipe,
    start: RunState,
    pace: Callable[[int], int | None],
    photo_room: int | float,
) -> Iterator[Progress]:
    state, count = start.train, start.count
    _, refine_key = _keys(recipe)
    done, total = int(state.step), int(state.total)
    if done >= total:
        raise ValueError(f"nothing left to do: {done} of {total} steps are made")
    feed = batches(dataset.train, recipe.seed, done, recipe.resolution, photo_room)
    for step, batch in enumerate(feed, done + 1):
        state, loss = train_step(state, batch, recipe)
        if recipe.density.due(step):
            gaussians, broken = without_broken(state.gaussians)
            refined = recipe.density.refine(
                state.density_state,
                gaussians,
                count,
                step,
                dataset.extent,
                jax.random.fold_in(refine_key, step),
            )
            count = refined.count
            state = replace(
                state,
                gaussians=refined.gaussians,
                opt_state=inherit(state.opt_state, refined.lineage, refined.gaussians, recipe.optimizer.rule),
                density_state=refined.state,
                faults=state.faults._replace(gaussians=state.faults.gaussians + broken),
            )
        yield Progress(step, total, loss, count, state)
        planned = pace(step)
        if planned is not None:
            total = planned
            state = replace(state, total=jnp.int32(total))
        if step >= total:
            return
