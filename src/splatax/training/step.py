"""One training step: render a view, compare, and move the Gaussians. The lines that matter."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from splatax import rasterizers
from splatax.gaussians import Gaussians
from splatax.projection import project
from splatax.rendering import over
from splatax.training import faults, optimizer
from splatax.training.faults import Faults
from splatax.training.feed import Batch
from splatax.training.recipes import Recipe


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """The whole run at one moment.

    Attributes:
        step: how many steps have been made.
        gaussians: the scene, the living first, then empty slots.
        opt_state: Adam's.
        density_state: of the density strategy.
        appearance: what is learned of the photos' colours.
        cameras: what is learned of the photos' cameras.
        faults: numbers that were not finite, until now.
        key: what all randomness of the run comes from.
        extent: of the scene, world units.
    """

    step: Int[Array, ""]
    gaussians: Gaussians
    opt_state: optax.OptState
    density_state: Any
    appearance: Any
    cameras: Any
    faults: Faults
    key: PRNGKeyArray
    extent: Float[Array, ""]


@partial(jax.jit, static_argnames="recipe", donate_argnames="state")
def train_step(state: TrainState, batch: Batch, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
    """Makes one step on one view; returns the new state and the loss. The old state is used up.

    The backend named by the recipe must be resolved already.
    """
    background_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    background = recipe.background.sample(background_key)
    photo = photo_over(batch.photo, background)

    def image_loss(splats, look):
        sums, alpha = rasterizers.composite(splats, splats.colors, backend=recipe.backend)
        image = over(recipe.appearance(look, sums, alpha), alpha, background)
        return recipe.loss(image, photo, batch.mask, backend=recipe.backend)

    def project_view(gaussians, pose):
        camera = recipe.refinement(pose, batch.camera, state.extent)
        splats = project(gaussians, camera, low_pass=recipe.low_pass, backend=recipe.backend)
        return splats, recipe.prior(gaussians, state.extent)

    look = recipe.appearance.of(state.appearance, batch.source)
    pose = recipe.refinement.of(state.cameras, batch.source)
    (splats, prior), pull_back = jax.vjp(project_view, state.gaussians, pose)
    loss, (d_splats, d_look) = jax.value_and_grad(image_loss, argnums=(0, 1))(splats, look)
    gradients, d_pose = pull_back((d_splats, jnp.ones_like(prior)))

    gradients = optimizer.without_locked_bands(gradients, state.step, recipe.sh_every)
    progress = state.step.astype(jnp.float32) / recipe.steps
    rates = recipe.learning_rates.at(progress, state.extent, gradients.sh.shape[1])
    gaussians, opt_state = optimizer.update(state.gaussians, gradients, state.opt_state, rates)
    gaussians = lax.optimization_barrier(gaussians)
    gaussians = recipe.noise(gaussians, rates.means[0, 0], state.extent, noise_key)
    after = replace(
        state,
        step=state.step + 1,
        gaussians=gaussians,
        opt_state=opt_state,
        density_state=recipe.density.observe(state.density_state, splats, d_splats),
        appearance=recipe.appearance.update(state.appearance, batch.source, d_look, progress),
        cameras=recipe.refinement.update(state.cameras, batch.source, d_pose, progress, recipe.steps),
    )
    return sound(after, state, *faults.find(state.gaussians, gradients, (d_look, d_pose), loss)), loss


def sound(
    after: TrainState, before: TrainState, fine: Bool[Array, ""], at_fault: Bool[Array, " n"]
) -> TrainState:
    """The state after a step in which all was finite. If not, the one before it, but one step on and
    without the Gaussians at fault."""
    kept = replace(
        faults.chosen(fine, after, before),
        step=after.step,
        faults=faults.counted(before.faults, fine, at_fault),
    )
    gaussians, opt_state = faults.emptied(kept.gaussians, kept.opt_state, at_fault)
    return replace(kept, gaussians=gaussians, opt_state=opt_state)


def photo_over(photo: UInt8[Array, "h w c"], background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """A photo as numbers in [0, 1]; one with alpha, over the background."""
    pixels = photo.astype(jnp.float32) / 255
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3]
    return over(pixels[..., :3] * alpha[..., None], alpha, background)
