"""One training step on several views, on any number of devices, with the same bits on each number.

    owner of rows      project(its rows, every camera)      d rows  <- mean over views, in their order
                          |  all-to-all                        ^
    drawer of views    draw, compare, d splats  -------- all-to-all back

The device that draws a view gets all of its splats in the order of the scene, and the device that owns a row
gets its gradients from all views. Only counts are summed across devices.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Float, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training import travel
from splatax.training.canvases import filling
from splatax.training.comparison import Differences, Views, compare_views
from splatax.training.devices import (
    AXIS,
    BLOCK,
    EVERYWHERE,
    ROWS,
    VIEWS,
    by_block,
    own_blocks,
    placement,
)
from splatax.training.moving import Pace, Rows, by_kernel, by_optax, draws_as_kernels, rule_of
from splatax.training.optimizer import LearningRates
from splatax.training.protocols import Source
from splatax.training.recipes import Recipe
from splatax.training.step import TrainState, advanced, of_whole


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
    devices if the backend computes each row independently, as "cpu" does.

    Args:
        state: placed on the devices.
        views: of the step; the devices divide them.
        rates: learning rates of the recipe.
        openings: as `ShSchedule.openings`.
        recipe: the settings, with kernels; see `Drawing.kernels`.
        mesh: the devices.
    """
    places = placement(state)
    seen = jax.tree.map(lambda _: EVERYWHERE, views)
    for name in ("photo", "mask", "landmarks"):
        if getattr(views, name) is not None:
            seen = replace(seen, **{name: VIEWS})
    step = partial(_on_each, recipe=recipe, packed=not travel.share_memory(mesh))
    sharded = jax.shard_map(
        step,
        mesh=mesh,
        in_specs=(places, seen, EVERYWHERE, EVERYWHERE),
        out_specs=(places, EVERYWHERE),
        check_vma=False,
    )
    return sharded(state, views, rates, openings)


def _on_each(
    state: TrainState,
    views: Views,
    rates: LearningRates,
    openings: Float[Array, " bands"],
    recipe: Recipe,
    packed: bool,
) -> tuple[TrainState, Float[Array, ""]]:
    """Makes the part of one device in a step."""
    drawing_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    losses, splats, d = compare_views(state, views, recipe, drawing_key, packed)
    good = jnp.all(jnp.isfinite(losses))  # if not, nothing moves; see `splatax.training.step`

    living = lax.psum(jnp.sum(state.gaussians.opacity_logits > -jnp.inf), AXIS)
    living = of_whole(living, views.fraction)
    pace = Pace(rates, openings, state.step / state.total, good, living, state.extent)
    rows = Rows(state.gaussians, d.gaussians, state.opt_state, _reach(splats, state, recipe))
    gaussians, opt_state = _moved(rows, pace, noise_key, recipe, placement(state).opt_state)

    in_view = jax.vmap(filling)(
        replace(splats, period=None), replace(d.splats, period=None), views.camera.frame
    )
    density_state = _observed(state.density_state, *in_view, recipe)
    weights = _weights_updated(state, views.source, losses, recipe)
    learned = (density_state, *_photos_updated(state, views.source, d, recipe), weights)
    moved = replace(state, gaussians=gaussians, opt_state=opt_state)
    return advanced(moved, learned, good), jnp.mean(losses)


def _reach(splats: Splats, state: TrainState, recipe: Recipe) -> Float[Array, " n"]:
    """Returns the mean over the views of the length that the means' learning rate is a fraction of."""

    def block(_, depths):
        reach = jax.vmap(recipe.optimizer.reach, (1, None), 1)(depths, state.extent)
        return jnp.broadcast_to(jnp.mean(reach, axis=1), len(depths))

    return by_block(block, jnp.moveaxis(splats.depths, 0, 1))


def _moved(
    rows: Rows, pace: Pace, noise_key: PRNGKeyArray, recipe: Recipe, places: Any
) -> tuple[Gaussians, Any]:
    """Makes one step of the optimizer with own rows; returns the scene and the optimizer's state.

    The noise of each block of rows has a key of its own. `places` is the placement of the optimizer's state.
    """
    rule = rule_of(recipe)
    if rule is not None and draws_as_kernels(noise_key):
        keys = jax.vmap(partial(jax.random.fold_in, noise_key))(own_blocks(len(rows.gaussians)))
        return by_kernel(rows, pace, rule, jax.random.key_data(keys), BLOCK, recipe)

    leaves, tree = jax.tree.flatten(rows.opt_state)
    is_row = [place == ROWS for place in jax.tree.leaves(places)]
    by_row = [leaf for leaf, row in zip(leaves, is_row, strict=True) if row]

    def block(number, gaussians, gradients, by_row, reach):
        own = iter(by_row)
        opt_state = jax.tree.unflatten(
            tree, [next(own) if row else leaf for leaf, row in zip(leaves, is_row, strict=True)]
        )
        key = jax.random.fold_in(noise_key, number)
        gaussians, opt_state = by_optax(Rows(gaussians, gradients, opt_state, reach), pace, key, recipe)
        return gaussians, jax.tree.leaves(opt_state)

    gaussians, moved = by_block(block, rows.gaussians, rows.gradients, by_row, rows.reach)
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
