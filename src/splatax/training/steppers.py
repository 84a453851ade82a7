"""Makers of steps: on one view by one device, or on several views by several devices."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras.canvases import Size, canvases_for
from splatax.dataset import Block, View
from splatax.training.comparison import Views
from splatax.training.devices import Sharding, devices_for
from splatax.training.feed import Batch, batches
from splatax.training.groups import steps_of
from splatax.training.photo_cache import PhotoCache
from splatax.training.processes import require_same
from splatax.training.protocols import DensityPlan, ResolutionSchedule
from splatax.training.recipes import Recipe
from splatax.training.refining import Kept, on_devices, on_one_device
from splatax.training.schedule import Schedule
from splatax.training.step import TrainState, train_step
from splatax.training.traced import of_a_step
from splatax.training.views import step_on_views

MOST_PROGRAMS = 4  # of training steps for a scene of one size; one takes seconds to compile


@runtime_checkable
class Stepper(Protocol):
    """Feeds and makes steps, and knows where the arrays of a run live."""

    def synchronize(self, facts: Callable[[], Mapping[str, str]]) -> None:
        """Waits for the other processes that make the steps, if there are any, before the first one.

        Args:
            facts: returns what decides the run, in short texts by what they are about.

        Raises:
            InputError: if the facts of the processes differ.
        """
        ...

    def placed(self, state: TrainState) -> TrainState:
        """Returns a state for `step`, from one whose rows are in order."""
        ...

    def gathered(self, state: TrainState, rows: int) -> TrainState:
        """Returns the first `rows` rows of a state in order, valid until the next step."""
        ...

    def in_order(self, arrays: Any, rows: int) -> Any:
        """Returns the first `rows` rows of arrays of a state in order, valid until the next step."""
        ...

    def refined(self, kept: Kept, plan: DensityPlan, rows: int, recipe: Recipe) -> Kept:
        """Returns what density control makes of a state; it has `rows` rows then."""
        ...

    def feed(
        self, views: Sequence[View], recipe: Recipe, done: int, schedule: Schedule, room: int | float
    ) -> Iterator[Any]:
        """Yields what each step from `done` on learns from, without end."""
        ...

    def step(self, state: TrainState, seen: Any, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
        """Makes a step; returns the new state and the loss. The old state is donated."""
        ...


@dataclass(frozen=True)
class OneView:
    """Steps on one view. The scene is on one device; photos are sent there for their steps.

    Attributes:
        surroundings: fields of `Batch` that are the same in all steps.
        device: the device; None for JAX's default.
    """

    surroundings: Mapping[str, Any] = field(default_factory=dict)
    device: jax.Device | None = None

    def synchronize(self, facts: Callable[[], Mapping[str, str]]) -> None:
        """Returns at once."""

    def placed(self, state: TrainState) -> TrainState:
        """Returns the state as it is, on the device."""
        return jax.device_put(state, self.device)

    def gathered(self, state: TrainState, rows: int) -> TrainState:
        """Returns the state as it is."""
        return state

    def in_order(self, arrays: Any, rows: int) -> Any:
        """Returns the arrays as they are."""
        return arrays

    def refined(self, kept: Kept, plan: DensityPlan, rows: int, recipe: Recipe) -> Kept:
        """Makes all rows at once."""
        return on_one_device(kept, plan, rows, recipe)

    def feed(
        self, views: Sequence[View], recipe: Recipe, done: int, schedule: Schedule, room: int | float
    ) -> Iterator[Batch]:
        """Yields one view after the other."""
        photos = PhotoCache(views, room, canvases_of(views, schedule))
        geometry = bool(recipe.objective.geometry.outputs)
        return batches(views, recipe.seed, done, schedule, photos, geometry)

    def step(self, state: TrainState, seen: Batch, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
        """Makes a step on one view."""
        return train_step(state, replace(seen, **self.surroundings), recipe)


@dataclass(frozen=True)
class SeveralViews:
    """Steps on several views, each drawn by one of several devices.

    Attributes:
        sharding: the devices.
        surroundings: as in `OneView`, on all devices.
    """

    sharding: Sharding
    surroundings: Mapping[str, Any] = field(default_factory=dict)

    def synchronize(self, facts: Callable[[], Mapping[str, str]]) -> None:
        """Compares facts with the processes of the other devices, and connects the devices."""
        if self.sharding.by_processes:
            require_same(facts())
            self.sharding.connect()

    def placed(self, state: TrainState) -> TrainState:
        """Distributes the rows of a state over the devices."""
        return self.sharding.placed(state)

    def gathered(self, state: TrainState, rows: int) -> TrainState:
        """Copies the rows of a state to the host."""
        return self.sharding.gathered(state, rows)

    def in_order(self, arrays: Any, rows: int) -> Any:
        """Copies rows of arrays to the host."""
        return self.sharding.in_order(arrays, rows)

    def refined(self, kept: Kept, plan: DensityPlan, rows: int, recipe: Recipe) -> Kept:
        """Makes the rows of each device there, from what the devices send each other."""
        return on_devices(kept, plan, rows, recipe, self.sharding)

    def feed(
        self, views: Sequence[View], recipe: Recipe, done: int, schedule: Schedule, room: int | float
    ) -> Iterator[Views]:
        """Yields the views of one step after the other."""
        photos = PhotoCache(views, room, canvases_of(views, schedule))
        return steps_of(views, recipe, done, schedule, self.sharding, photos)

    def step(self, state: TrainState, seen: Views, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
        """Makes a step on several views."""
        openings = jnp.asarray(recipe.sh.openings(recipe.steps))
        seen = replace(seen, **self.surroundings)
        return step_on_views(
            state, seen, recipe.optimizer.rates, openings, of_a_step(recipe), self.sharding.mesh
        )


def canvases_of(views: Sequence[View], resolution: ResolutionSchedule) -> list[Size | None] | None:
    """Returns the canvas of each photo, so that a scene of one size compiles at most `MOST_PROGRAMS` steps.

    Each combination of an image size, a factor of downscaling and a kind of lens is a program. A capture
    whose photos need no more has no canvases.
    """
    kinds = {jax.tree.structure(replace(view.camera, width=1, height=1)) for view in views}
    most = max(1, MOST_PROGRAMS // (len(kinds) * len(resolution.divisors)))
    return canvases_for([view.camera for view in views], most)


def stepper_for(recipe: Recipe, devices: Sequence[jax.Device] | None, block: Block | None = None) -> Stepper:
    """Returns how the steps of a recipe are made.

    Args:
        recipe: the settings.
        devices: on which; None for as many as divide the views of a step. One view is drawn by one device.
        block: the part of the scene that is trained; None for all of it.

    Raises:
        ValueError: if the devices do not divide the views.
    """
    if recipe.views < 1:
        raise ValueError(f"a step needs at least one view, not {recipe.views}")
    around = {} if block is None else {"context": block.context, "fraction": jnp.float32(block.fraction)}
    if recipe.views == 1 and devices is None:
        return OneView(around)
    if recipe.views == 1 and devices is not None and len(devices) == 1 and jax.process_count() == 1:
        return OneView(jax.device_put(around, devices[0]), devices[0])
    sharding = Sharding(devices_for(recipe.views, devices))
    everywhere = jax.tree.map(lambda leaf: sharding.everywhere(np.asarray(leaf)), around)
    return SeveralViews(sharding, everywhere)
