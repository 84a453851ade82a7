"""The training loop, a generator: progress bars, evaluation and viewers are `for` loops over it."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Integral

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from splatax import backends
from splatax.dataset import Dataset
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.shapes import check_kind
from splatax.training.capacity import bucket_for, pad, without_broken
from splatax.training.drawing import Drawing
from splatax.training.feed import rows_for
from splatax.training.fingerprints import facts_of
from splatax.training.initialize import require_visible
from splatax.training.recipes import Recipe
from splatax.training.refining import Due, Kept, planned, rows_after
from splatax.training.schedule import Schedule
from splatax.training.step import Faults, TrainState
from splatax.training.steppers import Stepper, stepper_for


@dataclass(frozen=True)
class RunState:
    """The state of a run between two steps, from which `optimize` can continue it.

    Attributes:
        train: the state that the steps change. The next step donates it: it cannot be used afterwards.
        count: number of living Gaussians.
    """

    train: TrainState
    count: int


@dataclass(frozen=True)
class Progress:
    """The result of one step, as `optimize` yields it.

    Attributes:
        step: number of steps made, from 1.
        total: number of steps of the whole run, as planned now.
        loss: of the step's view; reading it waits for the step to end.
        count: number of Gaussians.
    """

    step: int
    total: int
    loss: Float[Array, ""]
    count: int
    _state: TrainState
    _rows: int  # of the scene, with its empty slots
    _stepper: Stepper
    _drawing: Drawing

    @property
    def state(self) -> RunState:
        """The state from which `optimize` continues after this step, valid until the next step."""
        return RunState(self._stepper.gathered(self._state, self._rows), self.count)

    @property
    def faults(self) -> Faults:
        """Counts of what was not finite until now, valid until the next step."""
        return self._state.faults

    @property
    def gaussians(self) -> Gaussians:
        """A copy of the scene after this step.

        Take it before the next step, which donates the arrays that it is copied from.
        """
        return jax.tree.map(lambda leaf: jnp.array(leaf[: self.count]), self.padded)

    @property
    def padded(self) -> Gaussians:
        """The scene with its empty slots, valid until the next step.

        Render this to display a scene that grows: its shape, and with it the compiled program, changes
        rarely.
        """
        gaussians = jax.tree.map(jnp.asarray, self._stepper.in_order(self._state.gaussians, self._rows))
        return self._drawing.of(gaussians)


def fit(dataset: Dataset, recipe: Recipe) -> Gaussians:
    """Trains a scene to the end and returns it; see `optimize`."""
    for progress in optimize(dataset, recipe):
        pass
    return progress.gaussians


def optimize(
    dataset: Dataset,
    recipe: Recipe,
    start: RunState | None = None,
    pace: Callable[[int], int | None] | None = None,
    photo_room: int | float = math.inf,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[Progress]:
    """Trains a scene, and yields after each step. The same arguments give the same scene.

    The number of devices does not change the scene, see `splatax.training.views`. In a run of several
    processes, which `jax.distributed` has joined, all of them call this with the same arguments.

    Args:
        dataset: the capture.
        recipe: the settings.
        start: state of a run of the same capture and recipe, which continues as if it had never been
            stopped. The state is donated: it cannot be used afterwards.
        pace: called with the number of steps after each step, once that has been yielded. It returns a
            new total number of steps for the run, or None to keep the present one. Density control and the
            size of photos then follow the recipe's schedule at the same fraction of the run.
        photo_room: bytes of memory for decoded photos; those that do not fit are decoded for each step.
        devices: devices that share the views of a step; None for as many as there are and divide the views.

    Raises:
        DatasetError: if there are no training views, or nothing to start from that they see.
        InputError: if processes that make the steps together have other settings, captures or states.
        TypeError: if the data set or the recipe is of another kind.
        ValueError: if the recipe has no steps, none are left, its backend is not available, or the devices do
            not divide the views of a step.
    """
    check_kind("dataset", dataset, Dataset, "Give one, such as that of splatax.load_dataset(folder).")
    check_kind("recipe", recipe, Recipe, "Give one, such as splatax.recipes.default(steps=2000).")
    if not dataset.train:
        raise DatasetError("The capture has no photos to train on.")
    for name, count in (("steps", recipe.steps), ("views", recipe.views)):
        if not isinstance(count, Integral) or count < 1:
            raise ValueError(f"the {name} of a recipe must be a whole number of at least 1, not {count}")
    recipe = recipe.on(backends.resolve(recipe.drawing.backend))
    if start is None:
        gaussians = recipe.initialization(dataset, recipe.sh.degree, recipe.seed)
        require_visible(gaussians, dataset)
        padded = pad(gaussians, bucket_for(len(gaussians)))
        state = first_state(padded, recipe, dataset.extent, rows_for(dataset.train))
        start = RunState(state, len(gaussians))
    stepper = stepper_for(recipe, devices, dataset.block)
    stepper.synchronize(partial(facts_of, recipe, dataset, start.train))
    yield from _steps(dataset, recipe, start, pace or (lambda step: None), photo_room, stepper)


def first_state(gaussians: Gaussians, recipe: Recipe, extent: float, photos: int) -> TrainState:
    """Returns the state before the first step.

    Args:
        gaussians: the first scene, with its empty slots.
        recipe: the settings.
        extent: of the scene, world units.
        photos: number of training photos.
    """
    key, _ = _keys(recipe)
    return TrainState(
        step=jnp.int32(0),
        total=jnp.int32(recipe.steps),
        gaussians=gaussians,
        opt_state=recipe.optimizer.rule().init(gaussians),
        density_state=recipe.density.init(len(gaussians)),
        appearance=recipe.appearance.init(photos),
        cameras=recipe.camera_refinement.init(photos),
        weights=recipe.objective.weights.init(photos),
        key=key,
        extent=jnp.float32(extent),
        faults=Faults(jnp.int32(0), jnp.int32(0)),
    )


def _keys(recipe: Recipe) -> tuple[PRNGKeyArray, PRNGKeyArray]:
    """Returns the random keys for training steps and for density refinements."""
    key, refine_key = jax.random.split(jax.random.key(recipe.seed))
    return key, refine_key


def _steps(
    dataset: Dataset,
    recipe: Recipe,
    start: RunState,
    pace: Callable[[int], int | None],
    photo_room: int | float,
    stepper: Stepper,
) -> Iterator[Progress]:
    state, count = start.train, start.count
    _, refine_key = _keys(recipe)
    done, total = int(state.step), int(state.total)
    # A run may have been saved at the step of a change, which takes effect after that step.
    if done and (planned := pace(done)) is not None:
        total = planned
        state = replace(state, total=jnp.int32(total))
    if done >= total:
        raise ValueError(f"nothing left to do: {done} of {total} steps are made")
    schedule = Schedule(recipe.steps, total, recipe.resolution)
    rows, state = len(state.gaussians), stepper.placed(state)
    feed = stepper.feed(dataset.train, recipe, done, schedule, photo_room)
    for step, seen in enumerate(feed, done + 1):
        state, loss = stepper.step(state, seen, recipe.at((step - 1) / total))
        if refinement := schedule.refinement(step, recipe.density):
            due = Due(refinement, dataset.extent, jax.random.fold_in(refine_key, step))
            state, rows, count = _refined(state, rows, count, due, recipe, stepper)
        yield Progress(step, total, loss, count, state, rows, stepper, recipe.drawing)
        planned = pace(step)
        if planned is not None:
            total = schedule.total = planned
            state = replace(state, total=jnp.int32(total))
        if step >= total:
            return


def _refined(
    state: TrainState, rows: int, count: int, due: Due, recipe: Recipe, stepper: Stepper
) -> tuple[TrainState, int, int]:
    """Removes broken Gaussians, and lets density control add and remove others.

    Args:
        state: the state, as the stepper holds it.
        rows: of the scene, with its empty slots.
        count: number of living Gaussians.
        due: the refinement.
        recipe: the settings.
        stepper: makes the steps.

    Returns:
        The state, its number of rows, and the number of living Gaussians.
    """
    gaussians, broken = without_broken(state.gaussians)
    columns = stepper.in_order(recipe.density.columns(state.density_state, gaussians), rows)
    plan = planned(columns, count, due, recipe)
    rows = rows_after(plan, rows)
    kept = stepper.refined(Kept(gaussians, state.opt_state, state.density_state), plan, rows, recipe)
    faults = state.faults
    if broken:
        faults = faults._replace(gaussians=faults.gaussians + broken)
    return replace(state, **kept._asdict(), faults=faults), rows, plan.count
