"""The comparison of several views with their photos, by devices that own rows of the scene and draw views.

See `splatax.training.views`.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.pytrees import pytree
from splatax.splats import Splats, for_kernels
from splatax.training.devices import BLOCK, from_all_views, own_views, sum_in_order
from splatax.training.protocols import Source
from splatax.training.recipes import Recipe
from splatax.training.step import Shown, Target, TrainState, shown, surroundings, weighted_loss
from splatax.training.travel import to_drawers, to_owners, travel_of


@pytree
@dataclass(frozen=True)
class Views:
    """The k training views of a step, all of one size. Photos and masks are with the devices that draw them.

    Attributes:
        camera: every array has a first axis of views.
        photo: 8-bit RGB or RGBA.
        mask: true where a pixel counts; None if all do.
        source: indices of each view and of its lens.
        landmarks: as in `Batch`.
        divisor: factor by which the photos were downscaled (static).
        context: as in `Batch`.
        fraction: as in `Batch`.
    """

    camera: Camera
    photo: UInt8[Array, "k h w c"]
    mask: Bool[Array, "k h w"] | None
    source: Source
    landmarks: Float[Array, "k m 3"] | None = None
    divisor: int = field(default=1, metadata={"static": True})
    context: Gaussians | None = None
    fraction: Float[Array, ""] | None = None


@dataclass(frozen=True)
class Differences:
    """Gradients of the losses of a step's views.

    Attributes:
        gaussians: of the mean loss, own rows, each photo with its weight.
        splats: of each view's own loss, own rows.
        appearance: of each view's own loss, all views.
        camera: of the mean loss, all views.
    """

    gaussians: Gaussians
    splats: Splats
    appearance: Any
    camera: Any


def compare_views(
    state: TrainState, views: Views, recipe: Recipe, key: PRNGKeyArray, packed: bool
) -> tuple[Float[Array, " k"], Splats, Differences]:
    """Returns the losses of all views, the splats of own rows in them, and the gradients.

    Args:
        state: own rows.
        views: of the step.
        recipe: the settings.
        key: of the backgrounds and the orders.
        packed: whether only splats that views show are sent.
    """
    count = views.source.view.shape[0]
    corrections = _for_photos(recipe.camera_refinement, state.cameras, views.source)
    backgrounds, by_depth = jax.vmap(recipe.drawing.sample)(jax.random.split(key, count))
    show = partial(_shown, views=views, by_depth=by_depth, recipe=recipe, extent=state.extent)
    view, pull_back = jax.vjp(show, state.gaussians, _for_each_block(corrections, state.gaussians))

    corrected = jax.vmap(recipe.camera_refinement, in_axes=(0, 0, None))
    cameras = corrected(corrections, views.camera, state.extent)
    appearances = _for_photos(recipe.appearance, state.appearance, views.source)
    weight = partial(recipe.objective.weights.of_photo, state.weights, progress=state.step / state.total)
    weights = jax.vmap(lambda photo: jnp.float32(1) * weight(photo))(views.source.view)
    appearances, backgrounds, own_by_depth, cameras, weights = jax.tree.map(
        own_views, (appearances, backgrounds, by_depth, cameras, weights)
    )

    def draw(here):
        view, appearance, target, by_depth = here
        context = surroundings(views.context, target.camera, recipe, views.divisor, by_depth)
        target = target._replace(context=context)
        return jax.value_and_grad(weighted_loss, argnums=(0, 1), has_aux=True)(
            view, appearance, target, recipe
        )

    sorted_view = view._replace(splats=for_kernels(view.splats))  # drawers need one number to sort by
    travel = travel_of(view.splats.extents) if packed else None
    progress = jnp.full(views.photo.shape[0], state.step / state.total)
    targets = Target(views.photo, views.mask, views.landmarks, backgrounds, cameras, progress, weights)
    (_, losses), (d_arrived, d_appearances) = lax.map(
        draw, (to_drawers(sorted_view, travel), appearances, targets, own_by_depth)
    )
    d_view = to_owners(d_arrived, travel)
    if view.splats.sort_keys is not None:
        keys = jnp.zeros_like(view.splats.sort_keys)
        d_view = d_view._replace(splats=replace(d_view.splats, sort_keys=keys))
    d_gaussians, d_corrections = pull_back(jax.tree.map(lambda leaf: leaf / count, d_view))
    losses, d_appearances = jax.tree.map(from_all_views, (losses, d_appearances))
    d_corrections = jax.tree.map(sum_in_order, d_corrections)
    return losses, view.splats, Differences(d_gaussians, d_view.splats, d_appearances, d_corrections)


def _for_photos(part: Any, state: Any, source: Source) -> Any:
    """Returns the parameters of the photos of a step, with a first axis of views."""
    return jax.vmap(part.for_photo, in_axes=(None, 0))(state, source)


def _for_each_block(corrections: Any, gaussians: Gaussians) -> Any:
    """Returns a copy of the corrections of cameras for each block of own rows.

    Each copy gets the gradient from its block, so that these are added in one order on any number of devices.
    """
    blocks = gaussians.means.shape[0] // BLOCK
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (blocks, *leaf.shape)), corrections)


def _shown(
    gaussians: Gaussians,
    corrections: Any,
    *,
    views: Views,
    by_depth: Bool[Array, " k"] | None,
    recipe: Recipe,
    extent: Float[Array, ""],
) -> Shown:
    """Projects own rows into every view; every array of the result has a first axis of views."""

    def seen(gaussians: Gaussians, corrections: Any) -> Shown:
        def one(correction, camera, by_depth):
            corrected = recipe.camera_refinement(correction, camera, extent)
            return shown(gaussians, corrected, recipe, views.divisor, by_depth)

        return jax.vmap(one)(corrections, views.camera, by_depth)

    # Kernels compute each row alone, but what JAX computes is rounded differently in arrays of other lengths.
    if not jax.tree.leaves(corrections) and not recipe.objective.geometry.outputs:
        return seen(gaussians, corrections)
    blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, BLOCK, *leaf.shape[1:]), gaussians)
    view = lax.map(lambda block: seen(*block), (blocks, corrections))

    def joined(leaf: Array) -> Array:
        if leaf.ndim == 2:  # a period, equal in all blocks
            return leaf[0]
        by_view = jnp.moveaxis(leaf, 0, 1)  # [view block row ...]
        parts = jnp.split(by_view, leaf.shape[2] // BLOCK, axis=2)  # the second of them: copies beyond a seam
        parts = [part.reshape(part.shape[0], -1, *part.shape[3:]) for part in parts]
        return jnp.concatenate(parts, axis=1)

    return jax.tree.map(joined, view)
