"""One training step: renders a view, compares it with its photo, and moves the Gaussians."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from splatax import backends
from splatax.drawn import Seen, unrolled
from splatax.gaussians import Gaussians
from splatax.outputs import over
from splatax.splats import Splats
from splatax.stages import composite, project
from splatax.training import geometry, optimizer
from splatax.training.feed import Batch
from splatax.training.optimizer import LearningRates
from splatax.training.recipes import Recipe


class Faults(NamedTuple):
    """Counts of what was not finite during a run."""

    steps: Int[Array, ""]  # steps whose loss was not finite: they changed nothing
    gaussians: Int[Array, ""]  # Gaussians that were not finite: they were removed


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """The complete state of a run between two steps.

    Attributes:
        step: number of steps made.
        total: number of steps of the whole run; schedules depend on step / total.
        gaussians: the scene: the living Gaussians first, then empty slots.
        opt_state: of the optimizer of the Gaussians.
        density_state: of the density strategy.
        appearance: of the appearance model.
        cameras: of the camera refinement.
        key: root of the random keys of all steps.
        extent: of the scene, world units.
        faults: what was not finite until now.
    """

    step: Int[Array, ""]
    total: Int[Array, ""]
    gaussians: Gaussians
    opt_state: optax.OptState
    density_state: Any
    appearance: Any
    cameras: Any
    key: PRNGKeyArray
    extent: Float[Array, ""]
    faults: Faults


def train_step(state: TrainState, batch: Batch, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
    """Makes one step on one view, and returns the new state and the loss.

    The old state is donated: it cannot be used afterwards. The backend named by the recipe must be
    resolved already.
    """
    # Numbers that depend on the length of the run are inputs of the program, so that runs of all lengths
    # share one program in the compilation cache.
    return _train_step(state, batch, recipe.optimizer.rates, recipe.sh.every, recipe)


@partial(jax.jit, static_argnames="recipe", donate_argnames="state")
def _train_step(
    state: TrainState, batch: Batch, learning_rates: LearningRates, sh_every: Int[Array, ""], recipe: Recipe
) -> tuple[TrainState, Float[Array, ""]]:
    background_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    loss, splats, d = compare(state, batch, recipe, recipe.background.sample(background_key))

    # A step whose loss is not finite has zero gradients and zero learning rates, so nothing moves. Selecting
    # between the old and the new state instead would take a copy of all moments.
    good = jnp.isfinite(loss)
    gradients = jax.tree.map(lambda leaf: jnp.where(good, leaf, 0), d.gaussians)
    gradients = optimizer.without_locked_bands(gradients, state.step, sh_every)
    progress = state.step / state.total
    reach = recipe.optimizer.reach(splats.depths, state.extent)
    rates = learning_rates.at(progress, reach, gradients.sh.shape[1])
    rates = jax.tree.map(lambda leaf: jnp.where(good, leaf, 0), rates)
    gaussians, opt_state = optimizer.update(
        state.gaussians, gradients, state.opt_state, rates, recipe.optimizer.rule
    )
    gaussians = lax.optimization_barrier(gaussians)
    gaussians = recipe.optimizer.noise(gaussians, rates.means[:, 0], state.extent, noise_key)
    total = state.total.astype(jnp.float32)
    learned = (
        recipe.density.observe(state.density_state, splats, d.splats),
        recipe.appearance.update(state.appearance, batch.source, d.appearance, progress, total),
        recipe.camera_refinement.update(state.cameras, batch.source, d.camera, progress, total),
    )
    known = state.density_state, state.appearance, state.cameras
    density_state, appearance, cameras = jax.tree.map(partial(jnp.where, good), learned, known)
    return replace(
        state,
        step=state.step + 1,
        gaussians=gaussians,
        opt_state=opt_state,
        density_state=density_state,
        appearance=appearance,
        cameras=cameras,
        faults=state.faults._replace(steps=state.faults.steps + ~good),
    ), loss


class Gradients(NamedTuple):
    """Gradients of one view's loss."""

    gaussians: Gaussians
    splats: Splats
    appearance: Any  # with respect to the photo's appearance parameters
    camera: Any  # with respect to the photo's camera parameters


def compare(
    state: TrainState, batch: Batch, recipe: Recipe, background: Float[Array, "3"]
) -> tuple[Float[Array, ""], Splats, Gradients]:
    """Returns the loss of a view, its splats, and the gradients of the loss."""
    photo = photo_over(batch.photo, background)
    kernels = backends.resolve(recipe.backend)
    objective = recipe.objective

    def image_loss(splats, appearance, channels, camera):
        sums, alpha = composite(splats, splats.colors, backend=kernels)
        image = over(recipe.appearance(appearance, sums, alpha), alpha, background)
        loss = objective.loss(image, photo, batch.mask, kernels.photometric)
        if not channels:
            return loss
        # Drawn apart, so that `pull` tells what the photo misses, and kernels need not know it of so many.
        seen = unrolled(Seen(replace(splats, pull=None), None, camera))
        images = geometry.drawn(objective.geometry.outputs, channels, seen, kernels)
        return loss + objective.geometry(images, camera, batch.landmarks, state.step / state.total)

    # The filter keeps its size in pixels of the full photo, so that smaller photos do not blur the scene.
    low_pass = replace(recipe.low_pass, variance=recipe.low_pass.variance / batch.divisor**2)

    def project_view(gaussians, correction):
        camera = recipe.camera_refinement(correction, batch.camera, state.extent)
        splats = project(gaussians, camera, low_pass=low_pass, backend=kernels)
        channels = geometry.channels(objective.geometry.outputs, Seen(splats, gaussians, camera))
        return (recipe.density.watch(splats), objective.prior(gaussians, state.extent), channels), camera

    appearance = recipe.appearance.for_photo(state.appearance, batch.source)
    correction = recipe.camera_refinement.for_photo(state.cameras, batch.source)
    (splats, prior, channels), pull_back, camera = jax.vjp(
        project_view, state.gaussians, correction, has_aux=True
    )
    loss, (d_splats, d_appearance, d_channels) = jax.value_and_grad(image_loss, argnums=(0, 1, 2))(
        splats, appearance, channels, camera
    )
    d_gaussians, d_camera = pull_back((d_splats, jnp.ones_like(prior), d_channels))
    return loss, splats, Gradients(d_gaussians, d_splats, d_appearance, d_camera)


def photo_over(photo: UInt8[Array, "h w c"], background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """Returns a photo as values in [0, 1]; one with alpha is composited over the background."""
    pixels = photo.astype(jnp.float32) / 255
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3]
    return over(pixels[..., :3] * alpha[..., None], alpha, background)
