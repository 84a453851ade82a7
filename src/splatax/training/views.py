"""One training step on several views, on any number of devices, with the same bits on each number.

    owner of rows      project(its rows, every camera)      d rows  <- mean over views, in their order
                          |  all-to-all                        ^
    drawer of views    draw, compare, d splats  -------- all-to-all back

Whoever draws a view gets all of its splats in the order of the scene, and whoever owns a row gets its
gradients from all views. Nothing is summed across devices but counts.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training import optimizer
from splatax.training.comparison import Differences, Views, compare_views
from splatax.training.devices import (
    AXIS,
    EVERYWHERE,
    ROWS,
    VIEWS,
    by_block,
    placement,
)
from splatax.training.optimizer import LearningRates
from splatax.training.protocols import Source
from splatax.training.recipes import Recipe
from splatax.training.step import TrainState, advanced, filling


@partial(jax.jit, static_argnames=("recipe", "mesh"), donate_argnames="state")
def step_on_views(
    state: TrainState,
    views: Views,
    rates: LearningRates,
    openings: Float[Array, " bands"],
    recipe: Recipe,
    mesh: Mesh,
) -> tuple[TrainState, Float[Array, ""]]:
    """Makes one step on several views, and returns the new state and the mean loss of the views.

    The old state is donated: it cannot be used afterwards. The result does not depend on the number of
    devices if the backend computes each row alone, as "cpu" does.

    Args:
        state: placed on the devices.
        views: of the step; the devices divide them.
        rates: learning rates of the recipe.
        openings: as `ShSchedule.openings`.
        recipe: the settings; the backend is resolved already.
        mesh: the devices.
    """
    places = placement(state)
    seen = jax.tree.map(lambda _: EVERYWHERE, views)
    for name in ("photo", "mask", "landmarks"):
        if getattr(views, name) is not None:
            seen = replace(seen, **{name: VIEWS})
    step = partial(_on_each, recipe=recipe)
    sharded = jax.shard_map(
        step,
        mesh=mesh,
        in_specs=(places, seen, EVERYWHERE, EVERYWHERE),
        out_specs=(places, EVERYWHERE),
        check_vma=False,
    )
    return sharded(state, views, rates, openings)


def _on_each(
    state: TrainState, views: Views, rates: LearningRates, openings: Float[Array, " bands"], recipe: Recipe
) -> tuple[TrainState, Float[Array, ""]]:
    """Makes the part of one device in a step."""
    background_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    losses, splats, d = compare_views(state, views, recipe, background_key)
    good = jnp.all(jnp.isfinite(losses))  # if not, nothing moves; see `splatax.training.step`

    gradients = jax.tree.map(lambda leaf: jnp.where(good, leaf, 0), d.gaussians)
    gradients = optimizer.without_locked_bands(gradients, state.step / state.total, openings)
    depths = jnp.moveaxis(splats.depths, 0, 1)
    gaussians, opt_state = _moved(state, gradients, depths, Move(rates, good, noise_key), recipe)

    in_view = jax.vmap(filling)(
        replace(splats, period=None), replace(d.splats, period=None), views.camera.frame
    )
    density_state = _observed(state.density_state, *in_view, recipe)
    weights = _weights_updated(state, views.source, losses, recipe)
    learned = (density_state, *_photos_updated(state, views.source, d, recipe), weights)
    moved = replace(state, gaussians=gaussians, opt_state=opt_state)
    return advanced(moved, learned, good), jnp.mean(losses)


class Move(NamedTuple):
    """The inputs of an optimizer step beside the gradients."""

    rates: LearningRates
    good: Bool[Array, ""]  # false if nothing may move
    noise_key: PRNGKeyArray


def _moved(
    state: TrainState, gradients: Gaussians, depths: Float[Array, "n k"], move: Move, recipe: Recipe
) -> tuple[Gaussians, Any]:
    """Makes one step of the optimizer with own rows; returns the scene and the optimizer's state."""
    leaves, tree = jax.tree.flatten(state.opt_state)
    is_row = [place == ROWS for place in jax.tree.leaves(placement(state).opt_state)]
    by_row = [leaf for leaf, row in zip(leaves, is_row, strict=True) if row]
    living = lax.psum(jnp.sum(state.gaussians.opacity_logits > -jnp.inf), AXIS)
    progress = state.step / state.total

    def block(number, gaussians, gradients, by_row, depths):
        prior = jax.grad(recipe.objective.prior)(gaussians, state.extent, living)
        gradients = jax.tree.map(lambda a, b: a + jnp.where(move.good, b, 0), gradients, prior)
        reach = jnp.mean(jax.vmap(recipe.optimizer.reach, (1, None), 1)(depths, state.extent), axis=1)
        rates = move.rates.at(progress, reach, gradients.sh.shape[1])
        rates = jax.tree.map(lambda leaf: jnp.where(move.good, leaf, 0), rates)
        own = iter(by_row)
        opt_state = jax.tree.unflatten(
            tree, [next(own) if row else leaf for leaf, row in zip(leaves, is_row, strict=True)]
        )
        gaussians, opt_state = optimizer.update(gaussians, gradients, opt_state, rates, recipe.optimizer.rule)
        gaussians = lax.optimization_barrier(gaussians)
        key = jax.random.fold_in(move.noise_key, number)
        gaussians = recipe.optimizer.noise(gaussians, rates.means[:, 0], state.extent, key)
        return gaussians, jax.tree.leaves(opt_state)

    gaussians, moved = by_block(block, state.gaussians, gradients, by_row, depths)
    # What is not by row, such as a step count, is equal after every block.
    moved = [
        new if row else new.reshape(-1, *old.shape)[0]
        for new, old, row in zip(moved, leaves, is_row, strict=True)
    ]
    return gaussians, jax.tree.unflatten(tree, moved)


def _observed(density_state: Any, splats: Splats, d_splats: Splats, recipe: Recipe) -> Any:
    """Shows density control one view after the other."""

    def observe(density_state, view):
        return by_block(lambda _, *rows: recipe.density.observe(*rows), density_state, *view), None

    if not jax.tree.leaves(density_state):
        return density_state
    return lax.scan(observe, density_state, (splats, d_splats))[0]


def _weights_updated(state: TrainState, source: Source, losses: Float[Array, " k"], recipe: Recipe) -> Any:
    """Returns the state of the weights of photos after the photos of a step, one after the other."""
    if not jax.tree.leaves(state.weights):
        return state.weights

    def update(weights, photo):
        return recipe.objective.weights.update(weights, *photo), None

    return lax.scan(update, state.weights, (source.view, losses))[0]


def _photos_updated(state: TrainState, source: Source, d: Differences, recipe: Recipe) -> tuple[Any, Any]:
    """Returns the states of appearances and of cameras after the photos of a step, one after the other."""
    progress, total = state.step / state.total, state.total.astype(jnp.float32)

    def update(states, photo):
        appearance, cameras = states
        source, d_appearance, d_camera = photo
        return (
            recipe.appearance.update(appearance, source, d_appearance, progress, total),
            recipe.camera_refinement.update(cameras, source, d_camera, progress, total),
        ), None

    return lax.scan(update, (state.appearance, state.cameras), (source, d.appearance, d.camera))[0]
