"""Training of Gaussians that follow a skeleton, from photos of it in known poses.

It uses the optimizer, loss, density control and schedules of a recipe. Poses and weights are learned too on
request.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax import backends
from splatax.dataset import Dataset
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.scene.skeleton import Pose, spun
from splatax.scene.skin import Rig
from splatax.training.capacity import bucket_for, pad, without_broken
from splatax.training.drawing import Drawing
from splatax.training.feed import batches
from splatax.training.recipes import Recipe, ShSchedule, default
from splatax.training.refining import Due, Kept, on_one_device, parents_of, planned, rows_after
from splatax.training.resolution import Resolution
from splatax.training.rigged_step import Fixed, Learned, RigState, first_state, rig_step
from splatax.training.schedule import Schedule

POSE_RATE = 5e-3  # radians per step, at the start
WEIGHT_RATE = 0.02  # of the logarithms, a step, at the start


@dataclass(frozen=True)
class RigRun:
    """A run between two steps, from which `optimize_rig` can continue it.

    Attributes:
        train: the state that the steps change. The next step donates it: it cannot be used afterwards.
        count: number of Gaussians.
        rig: the rig that the run was started with, for its skeleton.
    """

    train: RigState
    count: int
    rig: Rig


@dataclass(frozen=True)
class RigProgress:
    """The result of one step, as `optimize_rig` yields it.

    Attributes:
        step: number of steps made, from 1.
        loss: of the step's photo; reading it waits for the step to end.
        run: the run after the step, valid until the next step.
    """

    step: int
    loss: Float[Array, ""]
    run: RigRun
    _poses: Pose
    _names: tuple[str, ...]
    _drawing: Drawing

    @property
    def count(self) -> int:
        """The number of Gaussians."""
        return self.run.count

    @property
    def gaussians(self) -> Gaussians:
        """A copy of the Gaussians in the bound pose."""
        gaussians = jax.tree.map(lambda leaf: jnp.array(leaf[: self.count]), self.run.train.gaussians)
        return self._drawing.of(gaussians)

    @property
    def rig(self) -> Rig:
        """The skeleton, and a copy of the weights."""
        state = self.run.train
        weights = jax.nn.softmax(state.logits[: self.count], axis=1)
        return replace(self.run.rig, indices=jnp.array(state.indices[: self.count]), weights=weights)

    @property
    def poses(self) -> dict[str, Pose]:
        """The poses as they are learned now, by name."""
        turns = self.run.train.turns.values.reshape(len(self._names), -1, 3)
        moved = jax.vmap(spun)(self._poses, turns)
        return {name: _row(moved, i) for i, name in enumerate(self._names)}


def _row(pose: Pose, index: int) -> Pose:
    return jax.tree.map(lambda leaf: leaf[index], pose)


def optimize_rig(
    dataset: Dataset,
    recipe: Recipe,
    start: tuple[Gaussians, Rig] | RigRun,
    poses: Mapping[str, Pose],
    pose_of: Mapping[str, str],
    learned: Learned = Learned(),
) -> Iterator[RigProgress]:
    """Trains Gaussians in the bound pose of a skeleton, and yields after each step.

    A new Gaussian follows the joints of its parent. The recipe's models of cameras, appearance
    and geometry are not used.

    Args:
        dataset: the photos.
        recipe: the settings.
        start: Gaussians in the bound pose and their rig, such as `scene.binding.covering(body, 6000)`; or a
            run with the same arguments that was stopped, which continues as if it never had been. It is
            donated: it cannot be used afterwards.
        poses: poses of the skeleton by name.
        pose_of: name of the pose in each training photo, by the photo's name.
        learned: learning rates of the poses and the weights.

    Raises:
        DatasetError: if there are no training photos, or one has no pose. ValueError: if the recipe has
            several views per step, which this trainer does not make, or no steps are left.
    """
    if recipe.views != 1 or recipe.steps < 1:
        raise ValueError(
            f"a rig is trained in at least one step of one view, not {recipe.steps} steps of {recipe.views}"
        )
    if not dataset.train:
        raise DatasetError("The capture has no photos to train on.")
    for view in dataset.train:
        if pose_of.get(view.name) not in poses:
            raise DatasetError(f"{view.name}: no pose is given for this photo. Add it to the poses.")
    recipe = recipe.on(backends.resolve(recipe.drawing.backend))
    names, stacked = tuple(poses), _stacked(poses)
    of_photos = {view.photo: names.index(pose_of[view.name]) for view in dataset.train}
    which = jnp.asarray(list(of_photos.values()), jnp.int32)
    run = start if isinstance(start, RigRun) else _first_run(*start, recipe, len(names))
    state, count, done = run.train, run.count, int(run.train.step)
    if done >= recipe.steps:
        raise ValueError(f"nothing left to do: {done} of {recipe.steps} steps are made")
    refine_key, step_key = jax.random.split(jax.random.key(recipe.seed))
    schedule = Schedule(recipe.steps, recipe.steps, recipe.resolution)
    settings = Fixed(run.rig, stacked, which, jnp.float32(dataset.extent), step_key)
    for step, batch in enumerate(batches(dataset.train, recipe.seed, done, schedule), done + 1):
        state, loss = rig_step(state, batch, settings, recipe, learned)
        if refinement := schedule.refinement(step, recipe.density):
            state, count = _refined(state, count, refinement, dataset.extent, recipe, refine_key)
        now = RigRun(state, count, run.rig)
        yield RigProgress(step, loss, now, stacked, names, recipe.drawing)
        if step >= recipe.steps:
            return


def result_of(run: RigRun, recipe: Recipe, poses: Mapping[str, Pose], loss: float) -> RigProgress:
    """Returns the result of a run that was saved after its last step, whose loss is given."""
    last = jnp.float32(loss)
    return RigProgress(int(run.train.step), last, run, _stacked(poses), tuple(poses), recipe.drawing)


def state_shapes(rows: int, rig: Rig, recipe: Recipe, poses: int) -> RigState:
    """Returns the shapes and dtypes of the state of a run with this many rows, with empty ones."""
    count = harmonics.count(recipe.sh.degree)
    widths = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh": (count, 3)}
    shapes = {name: jax.ShapeDtypeStruct((rows, *own), jnp.float32) for name, own in widths.items()}
    following = rig.indices.shape[1]

    def first(gaussians, indices, weights):
        return first_state(gaussians, replace(rig, indices=indices, weights=weights), recipe, poses)

    return jax.eval_shape(
        first,
        Gaussians(**shapes),  # type: ignore[arg-type]
        jax.ShapeDtypeStruct((rows, following), jnp.int32),
        jax.ShapeDtypeStruct((rows, following), jnp.float32),
    )


def _stacked(poses: Mapping[str, Pose]) -> Pose:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *poses.values())


def _first_run(gaussians: Gaussians, rig: Rig, recipe: Recipe, poses: int) -> RigRun:
    rows = bucket_for(len(gaussians))
    spare = [(0, rows - len(gaussians)), (0, 0)]
    padded = replace(rig, indices=jnp.pad(rig.indices, spare), weights=jnp.pad(rig.weights, spare))
    return RigRun(first_state(pad(gaussians, rows), padded, recipe, poses), len(gaussians), rig)


def _refined(
    state: RigState, count: int, refinement: int, extent: float, recipe: Recipe, key: Any
) -> tuple[RigState, int]:
    """Refines the scene; each new Gaussian has the joints and weights of its parent."""
    gaussians, _ = without_broken(state.gaussians)
    due = Due(refinement, extent, jax.random.fold_in(key, refinement))
    plan = planned(recipe.density.columns(state.density_state, gaussians), count, due, recipe)
    rows = rows_after(plan, len(gaussians))
    kept = on_one_device(Kept(gaussians, state.opt_state, state.density_state), plan, rows, recipe)
    parents = parents_of(plan, rows)
    moments = jax.tree.map(lambda leaf: leaf[parents] if leaf.ndim else leaf, state.weights_state)
    return replace(
        state,
        **kept._asdict(),
        indices=state.indices[parents],
        logits=state.logits[parents],
        weights_state=moments,
    ), plan.count


REFINED = {  # what to learn beside the Gaussians, by the name of the command's option
    "none": Learned(),
    "weights": Learned(weight_rate=WEIGHT_RATE),
    "poses": Learned(pose_rate=POSE_RATE),
    "poses+weights": Learned(POSE_RATE, WEIGHT_RATE),
}


def recipe_for(steps: int, max_gaussians: int, seed: int = 0) -> Recipe:
    """Returns the recipe `default` at full resolution, without view-dependent colour."""
    recipe = default(steps, max_gaussians)
    return replace(recipe, resolution=Resolution(), sh=ShSchedule(degree=0), seed=seed)
