"""One training step: render a view, compare, and move the Gaussians. The lines that matter."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from splatax import backends
from splatax.gaussians import Gaussians
from splatax.rendering import composite, over, project
from splatax.splats import Splats
from splatax.training import optimizer
from splatax.training.feed import Batch
from splatax.training.optimizer import LearningRates
from splatax.training.recipes import Recipe


class Faults(NamedTuple):
    """Numbers of what went wrong and was mended."""

    steps: Int[Array, ""]  # whose loss was not finite: they have changed nothing
    gaussians: Int[Array, ""]  # that were not finite: they were removed


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """The whole run at one moment.

    Attributes:
        step: how many steps have been made.
        total: how many the run shall have; schedules go by the share that is done.
        gaussians: the scene, the living first, then empty slots.
        opt_state: Adam's.
        density_state: of the density strategy.
        appearance: what is learned of the photos' colours.
        cameras: what is learned of the photos' cameras.
        key: what all randomness of the run comes from.
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
    """Makes one step on one view; returns the new state and the loss. The old state is used up.

    The backend named by the recipe must be resolved already.
    """
    # Numbers that differ from run to run are inputs of the program, so that it is compiled once for all.
    return _train_step(state, batch, recipe.optimizer.rates, recipe.sh.every, recipe)


@partial(jax.jit, static_argnames="recipe", donate_argnames="state")
def _train_step(
    state: TrainState, batch: Batch, learning_rates: LearningRates, sh_every: Int[Array, ""], recipe: Recipe
) -> tuple[TrainState, Float[Array, ""]]:
    background_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    loss, splats, d = compare(state, batch, recipe, recipe.background.sample(background_key))

    # Of a bad step, the gradients count as zero and nothing moves. To choose between the old and the new
    # scene as a whole would take a copy of all moments.
    good = jnp.isfinite(loss)
    gradients = jax.tree.map(lambda leaf: jnp.where(good, leaf, 0), d.gaussians)
    gradients = optimizer.without_locked_bands(gradients, state.step, sh_every)
    progress = state.step / state.total
    rates = learning_rates.at(progress, state.extent, gradients.sh.shape[1])
    rates = jax.tree.map(lambda leaf: jnp.where(good, leaf, 0), rates)
    gaussians, opt_state = optimizer.update(
        state.gaussians, gradients, state.opt_state, rates, recipe.optimizer.rule
    )
    gaussians = lax.optimization_barrier(gaussians)
    gaussians = recipe.optimizer.noise(gaussians, rates.means[0, 0], state.extent, noise_key)
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
    """Of the loss of a view."""

    gaussians: Gaussians
    splats: Splats
    appearance: Any  # of the photo's parameters
    camera: Any  # of its parameters


def compare(
    state: TrainState, batch: Batch, recipe: Recipe, background: Float[Array, "3"]
) -> tuple[Float[Array, ""], Splats, Gradients]:
    """The loss of a view, the splats in it, and all gradients."""
    photo = photo_over(batch.photo, background)
    kernels = backends.resolve(recipe.backend)

    def image_loss(splats, look):
        sums, alpha = composite(splats, splats.colors, backend=kernels)
        image = over(recipe.appearance(look, sums, alpha), alpha, background)
        return recipe.loss(image, photo, batch.mask, kernels.photometric)

    # Of pixels of the whole photo, so that a smaller one teaches a scene that is sharp on the whole one.
    low_pass = replace(recipe.low_pass, variance=recipe.low_pass.variance / batch.divisor**2)

    def project_view(gaussians, pose):
        camera = recipe.camera_refinement(pose, batch.camera, state.extent)
        splats = project(gaussians, camera, low_pass=low_pass, backend=kernels)
        return recipe.density.watch(splats), recipe.prior(gaussians, state.extent)

    look = recipe.appearance.for_photo(state.appearance, batch.source)
    pose = recipe.camera_refinement.for_photo(state.cameras, batch.source)
    (splats, prior), pull_back = jax.vjp(project_view, state.gaussians, pose)
    loss, (d_splats, d_look) = jax.value_and_grad(image_loss, argnums=(0, 1))(splats, look)
    d_gaussians, d_pose = pull_back((d_splats, jnp.ones_like(prior)))
    return loss, splats, Gradients(d_gaussians, d_splats, d_look, d_pose)


def photo_over(photo: UInt8[Array, "h w c"], background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """A photo as numbers in [0, 1]; one with alpha, over the background."""
    pixels = photo.astype(jnp.float32) / 255
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3]
    return over(pixels[..., :3] * alpha[..., None], alpha, background)
