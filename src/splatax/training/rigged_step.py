"""The step of training Gaussians that follow a skeleton, and the state that it changes."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from splatax import pipeline
from splatax.gaussians import Gaussians
from splatax.outputs import over
from splatax.pytrees import pytree
from splatax.scene.skeleton import Pose, spun
from splatax.scene.skin import Rig, skin
from splatax.training import per_photo
from splatax.training.camera_refinement import FINAL_RATE
from splatax.training.drawing import reordered
from splatax.training.feed import Batch
from splatax.training.moving import Pace, Rows, moved
from splatax.training.per_photo import PerPhoto
from splatax.training.recipes import Recipe
from splatax.training.step import filtered, photo_over

ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-15)  # of the weights, as of the Gaussians


@dataclass(frozen=True)
class Learned:
    """Learning rates of the poses and the weights, which are learned beside the Gaussians.

    Attributes:
        pose_rate: first learning rate of the joints' rotations, radians per step; 0 keeps the poses as given.
        weight_rate: first learning rate of the logarithms of the weights; 0 keeps the weights.
    """

    pose_rate: float = 0.0
    weight_rate: float = 0.0


@pytree
@dataclass(frozen=True)
class RigState:
    """The state of a run between two steps.

    Attributes:
        step: number of steps made.
        gaussians: in the bound pose, with empty slots.
        opt_state: of the optimizer of the Gaussians.
        density_state: of the density strategy.
        indices: joints of each Gaussian.
        logits: logarithms of the weights, up to a constant for each Gaussian.
        weights_state: of the optimizer of the logits.
        turns: rotation vector of each joint in each pose, radians, after the pose as given.
    """

    step: Int[Array, ""]
    gaussians: Gaussians
    opt_state: Any
    density_state: Any
    indices: Int[Array, "n k"]
    logits: Float[Array, "n k"]
    weights_state: Any
    turns: PerPhoto


@pytree
@dataclass(frozen=True)
class Fixed:
    """Arrays that do not change during a run; `which` is the pose of each photo."""

    rig: Rig
    poses: Pose
    which: Int[Array, " photos"]
    extent: Float[Array, ""]
    key: Any


def first_state(gaussians: Gaussians, rig: Rig, recipe: Recipe, poses: int) -> RigState:
    """Returns the state before the first step, of Gaussians and weights with empty slots."""
    logits = jnp.log(jnp.clip(rig.weights, 1e-4, 1))
    return RigState(
        jnp.int32(0),
        gaussians,
        recipe.optimizer.rule().init(gaussians),
        recipe.density.init(len(gaussians)),
        rig.indices,
        logits,
        ADAM.init(logits),
        per_photo.zeros(poses, 3 * len(rig.skeleton)),
    )


@partial(jax.jit, static_argnames=("recipe", "learned"), donate_argnames="state")
def rig_step(
    state: RigState, batch: Batch, settings: Fixed, recipe: Recipe, learned: Learned
) -> tuple[RigState, Float[Array, ""]]:
    """Makes one step with one photo, and returns the state and the loss."""
    drawing_key, noise_key = jax.random.split(jax.random.fold_in(settings.key, state.step))
    background, by_depth = recipe.drawing.sample(drawing_key)
    kernels = recipe.drawing.kernels
    photo = photo_over(batch.photo, background)
    pose = settings.which[batch.source.view]
    low_pass = filtered(recipe.drawing.low_pass, batch.divisor)

    def project_view(gaussians, logits, turns):
        rig = replace(settings.rig, indices=state.indices, weights=jax.nn.softmax(logits, axis=1))
        given = jax.tree.map(lambda leaf: leaf[pose], settings.poses)
        joints = rig.skeleton.worlds(spun(given, turns.reshape(-1, 3)))
        posed = replace(skin(gaussians, rig, joints), order=recipe.drawing.order)
        splats = reordered(pipeline.project(posed, batch.camera, low_pass, kernels), by_depth)
        return recipe.density.watch(splats)

    def image_loss(splats):
        sums, alpha = pipeline.composite(splats, splats.colors, kernels)
        return recipe.objective.loss(over(sums, alpha, background), photo, batch.mask, kernels.photometric)

    parameters = state.gaussians, state.logits, state.turns.values[pose]
    splats, pull_back = jax.vjp(project_view, *parameters)
    loss, d_splats = jax.value_and_grad(image_loss)(splats)
    good = jnp.isfinite(loss)
    d_gaussians, *d_learned = pull_back(d_splats)
    d_logits, d_turns = (jnp.where(good, leaf, 0) for leaf in d_learned)
    progress = state.step / recipe.steps
    reach = recipe.optimizer.reach(splats.depths, settings.extent)
    living = jnp.sum(state.gaussians.opacity_logits > -jnp.inf)
    openings = jnp.asarray(recipe.sh.openings(recipe.steps))
    rows = Rows(state.gaussians, d_gaussians, state.opt_state, reach)
    pace = Pace(recipe.optimizer.rates, openings, progress, good, living, settings.extent)
    gaussians, opt_state = moved(rows, pace, noise_key, recipe)
    fall = jnp.where(good, per_photo.log_linear(1.0, FINAL_RATE, progress), 0)
    logits, weights_state, turns = state.logits, state.weights_state, state.turns
    if learned.weight_rate:
        direction, weights_state = ADAM.update(d_logits, weights_state)
        logits = logits - learned.weight_rate * fall * direction
    if learned.pose_rate:
        turns = per_photo.updated(turns, pose, d_turns, learned.pose_rate * fall)
    observed = recipe.density.observe(state.density_state, splats, d_splats)
    return replace(
        state,
        step=state.step + 1,
        gaussians=gaussians,
        opt_state=opt_state,
        density_state=jax.tree.map(partial(jnp.where, good), observed, state.density_state),
        logits=logits,
        weights_state=weights_state,
        turns=turns,
    ), loss
