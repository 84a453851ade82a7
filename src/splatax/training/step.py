"""One training step: render a view, compare, and move the Gaussians. The lines that matter."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from splatax import rasterizers
from splatax.gaussians import Gaussians
from splatax.projection import project
from splatax.rendering import over
from splatax.training import optimizer
from splatax.training.feed import Batch
from splatax.training.recipes import Recipe


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
        key: what all randomness of the run comes from.
        extent: of the scene, world units.
    """

    step: Int[Array, ""]
    total: Int[Array, ""]
    gaussians: Gaussians
    opt_state: optax.OptState
    density_state: Any
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

    def image_loss(splats):
        sums, alpha = rasterizers.composite(splats, splats.colors, backend=recipe.backend)
        return recipe.loss(over(sums, alpha, background), photo, batch.mask, backend=recipe.backend)

    def project_view(gaussians):
        splats = project(gaussians, batch.camera, low_pass=recipe.low_pass, backend=recipe.backend)
        return splats, recipe.prior(gaussians, state.extent)

    (splats, prior), pull_back = jax.vjp(project_view, state.gaussians)
    loss, d_splats = jax.value_and_grad(image_loss)(splats)
    (gradients,) = pull_back((d_splats, jnp.ones_like(prior)))

    gradients = optimizer.without_locked_bands(gradients, state.step, recipe.sh_every)
    progress = state.step / state.total
    rates = recipe.learning_rates.at(progress, state.extent, gradients.sh.shape[1])
    gaussians, opt_state = optimizer.update(state.gaussians, gradients, state.opt_state, rates)
    gaussians = lax.optimization_barrier(gaussians)
    gaussians = recipe.noise(gaussians, rates.means[0, 0], state.extent, noise_key)
    return replace(
        state,
        step=state.step + 1,
        gaussians=gaussians,
        opt_state=opt_state,
        density_state=recipe.density.observe(state.density_state, splats, d_splats),
    ), loss


def photo_over(photo: UInt8[Array, "h w c"], background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """A photo as numbers in [0, 1]; one with alpha, over the background."""
    pixels = photo.astype(jnp.float32) / 255
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3]
    return over(pixels[..., :3] * alpha[..., None], alpha, background)
