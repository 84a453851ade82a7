"""One training step: renders a view, compares it with its photo, and moves the Gaussians."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from splatax import pipeline
from splatax.backends.protocol import PulledView
from splatax.cameras import Camera
from splatax.drawn import Seen, unrolled
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.outputs import over
from splatax.pytrees import pytree
from splatax.splats import Splats, for_kernels, joined
from splatax.training import geometry
from splatax.training.canvases import filling, on_canvas
from splatax.training.drawing import ByDepth, reordered
from splatax.training.feed import Batch
from splatax.training.moving import Pace, Rows, by_view, moved
from splatax.training.objectives import TrainingView
from splatax.training.optimizer import LearningRates
from splatax.training.recipes import Recipe
from splatax.training.traced import of_a_step


class Faults(NamedTuple):
    """Counts of what was not finite during a run."""

    steps: Int[Array, ""]  # steps whose loss was not finite: they changed nothing
    gaussians: Int[Array, ""]  # Gaussians that were not finite: they were removed


@pytree
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
        weights: of the weights of photos.
        key: root of the random keys of all steps.
        extent: of the scene, world units.
        faults: counts of what was not finite until now.
    """

    step: Int[Array, ""]
    total: Int[Array, ""]
    gaussians: Gaussians
    opt_state: optax.OptState
    density_state: Any
    appearance: Any
    cameras: Any
    weights: Any
    key: PRNGKeyArray
    extent: Float[Array, ""]
    faults: Faults


def train_step(state: TrainState, batch: Batch, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
    """Makes one step on one view, and returns the new state and the loss.

    The old state is donated: it cannot be used afterwards.

    Raises:
        ValueError: if the recipe names its backend, instead of holding the kernels; see `Drawing.kernels`.
    """
    # Numbers that depend on the length of the run are inputs of the program, so that runs of all lengths
    # share one program, in this process and in the compilation cache.
    return _train_step(
        state, batch, recipe.optimizer.rates, recipe.sh.openings(recipe.steps), of_a_step(recipe)
    )


@partial(jax.jit, static_argnames="recipe", donate_argnames="state")
def _train_step(
    state: TrainState,
    batch: Batch,
    learning_rates: LearningRates,
    openings: Float[Array, " bands"],
    recipe: Recipe,
) -> tuple[TrainState, Float[Array, ""]]:
    drawing_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    found = compare(state, batch, recipe, drawing_key)

    good = jnp.isfinite(found.loss)  # if not, nothing moves
    progress = state.step / state.total
    living = of_whole(jnp.sum(state.gaussians.opacity_logits > -jnp.inf), batch.fraction)
    splats, d_splats = found.shown.splats, found.d_shown.splats
    reach = recipe.optimizer.reach(splats.depths, state.extent)
    rows = Rows(state.gaussians, None, state.opt_state, reach)
    pace = Pace(learning_rates, openings, progress, good, living, state.extent)
    low_pass = filtered(recipe.drawing.low_pass, batch.divisor)
    at_once = by_view(found.camera, low_pass, noise_key, recipe)
    if at_once:
        view = PulledView(found.camera, low_pass, splats, d_splats)
        gaussians, opt_state, d_camera = at_once.moved(rows, view, pace, noise_key)
        d_correction = found.pull_camera(d_camera)
    else:
        d_gaussians, d_correction = found.pull_back(found.d_shown)
        gaussians, opt_state = moved(rows._replace(gradients=d_gaussians), pace, noise_key, recipe)
    total = state.total.astype(jnp.float32)
    learned = (
        recipe.density.observe(state.density_state, *filling(splats, d_splats, batch.camera.frame)),
        recipe.appearance.update(state.appearance, batch.source, found.d_appearance, progress, total),
        recipe.camera_refinement.update(state.cameras, batch.source, d_correction, progress, total),
        recipe.objective.weights.update(state.weights, batch.source.view, found.loss),
    )
    return advanced(replace(state, gaussians=gaussians, opt_state=opt_state), learned, good), found.loss


def of_whole(count: Int[Array, ""], fraction: Float[Array, ""] | None) -> Int[Array, ""]:
    """Returns the number of Gaussians of a whole scene, of which `count` are a fraction; None for all."""
    return count if fraction is None else jnp.round(count / fraction).astype(count.dtype)


def advanced(state: TrainState, learned: tuple[Any, Any, Any, Any], good: Bool[Array, ""]) -> TrainState:
    """Returns the state after a step that has moved the Gaussians.

    Args:
        state: before the step, with the moved Gaussians and the optimizer's new state.
        learned: new states of density control, appearance, cameras and the weights of photos; kept only if
            the step is good.
        good: whether the loss is finite. If not, the step is counted as a fault.
    """
    known = state.density_state, state.appearance, state.cameras, state.weights
    density_state, appearance, cameras, weights = jax.tree.map(partial(jnp.where, good), learned, known)
    return replace(
        state,
        step=state.step + 1,
        density_state=density_state,
        appearance=appearance,
        cameras=cameras,
        weights=weights,
        faults=state.faults._replace(steps=state.faults.steps + ~good),
    )


def filtered(low_pass: LowPass, divisor: int) -> LowPass:
    """Returns the filter for photos that are smaller by `divisor`.

    It keeps its size in pixels of the full photo, so that smaller photos do not blur the scene.
    """
    return replace(low_pass, variance=low_pass.variance / divisor**2)


class Shown(NamedTuple):
    """The part of a view that is drawn: its splats, and channels that the geometry penalty blends."""

    splats: Splats
    channels: dict[str, Float[Array, "m _"]]


class Compared(NamedTuple):
    """A view of a step and its photo. Gradients are of the loss times the weight of the photo."""

    loss: Float[Array, ""]
    shown: Shown
    camera: Camera  # as corrected
    d_shown: Shown
    d_appearance: Any  # with respect to the photo's appearance parameters
    pull_back: Callable[[Shown], tuple[Gaussians, Any]]  # to the scene and the photo's camera parameters
    pull_camera: Callable[[Camera], Any]  # from the camera to the photo's camera parameters


def compare(state: TrainState, batch: Batch, recipe: Recipe, key: PRNGKeyArray) -> Compared:
    """Draws a view, compares it with its photo, and finds the gradient of the loss in its splats."""
    background, by_depth = recipe.drawing.sample(key)

    def corrected(correction):
        return recipe.camera_refinement(correction, batch.camera, state.extent)

    def project_view(gaussians, correction):
        return shown(gaussians, corrected(correction), recipe, batch.divisor, by_depth)

    appearance = recipe.appearance.for_photo(state.appearance, batch.source)
    correction = recipe.camera_refinement.for_photo(state.cameras, batch.source)
    view, pull_back = jax.vjp(project_view, state.gaussians, correction)
    camera, pull_camera = jax.vjp(corrected, correction)
    progress = state.step / state.total
    weight = recipe.objective.weights.of_photo(state.weights, batch.source.view, progress)
    context = surroundings(batch.context, camera, recipe, batch.divisor, by_depth)
    target = Target(batch.photo, batch.mask, batch.landmarks, background, camera, progress, weight, context)
    (_, loss), (d_view, d_appearance) = jax.value_and_grad(weighted_loss, argnums=(0, 1), has_aux=True)(
        view, appearance, target, recipe
    )
    return Compared(
        loss, view, camera, d_view, d_appearance, pull_back, lambda d_camera: pull_camera(d_camera)[0]
    )


class Target(NamedTuple):
    """The photo that a view is compared with, and all else that the loss depends on."""

    photo: UInt8[Array, "h w c"]
    mask: Bool[Array, "h w"] | None
    landmarks: Float[Array, "k 3"] | None
    background: Float[Array, "3"]
    camera: Camera  # as corrected
    progress: Float[Array, ""]  # fraction of the run that is done
    weight: Any = 1.0  # of the photo in the loss: a scalar
    context: Shown | None = None  # drawn with the view, and not learned


def surroundings(
    context: Gaussians | None, camera: Camera, recipe: Recipe, divisor: int, by_depth: ByDepth
) -> Shown | None:
    """Projects the context of a view, see `Batch`, as `shown` does; None if there is none."""
    return None if context is None else shown(context, camera, recipe, divisor, by_depth)


def beside(view: Shown, context: Shown | None) -> Shown:
    """Returns what a photo shows: the splats that are trained, then those of the context."""
    if context is None:
        return view
    rows, more = len(view.splats.depths), len(context.splats.depths)

    def both(name: str) -> Float[Array, "m _"]:
        # The channels of a panorama have a second set of rows, for the copies beyond its seam.
        own, other = view.channels[name], context.channels[name]
        copies = len(own) // rows
        pairs = zip(jnp.split(own, copies), jnp.split(other, len(other) // more), strict=True)
        return jnp.concatenate([part for pair in pairs for part in pair])

    splats = joined([for_kernels(view.splats), for_kernels(context.splats)])
    return Shown(splats, {name: both(name) for name in view.channels})


def shown(gaussians: Gaussians, camera: Camera, recipe: Recipe, divisor: int, by_depth: ByDepth) -> Shown:
    """Projects a scene, or a part of it, for a photo that is smaller by `divisor`."""
    low_pass = filtered(recipe.drawing.low_pass, divisor)
    kernels = recipe.drawing.kernels
    ordered = replace(gaussians, order=recipe.drawing.order)
    splats = reordered(pipeline.project(ordered, camera, low_pass, kernels), by_depth)
    seen = Seen(splats, gaussians, camera, kernels=kernels)
    channels = geometry.channels(recipe.objective.geometry.outputs, seen)
    return Shown(recipe.density.watch(splats), channels)


def weighted_loss(
    view: Shown, appearance: Any, target: Target, recipe: Recipe
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the loss of a view times the weight of its photo, and the loss itself."""
    loss = image_loss(view, appearance, target, recipe)
    return loss * target.weight, loss


def image_loss(view: Shown, appearance: Any, target: Target, recipe: Recipe) -> Float[Array, ""]:
    """Draws a view in the colours of its photo, and returns the loss."""
    view = beside(view, target.context)
    kernels, objective = recipe.drawing.kernels, recipe.objective
    sums, alpha = pipeline.composite(view.splats, view.splats.colors, kernels)
    image = over(recipe.appearance(appearance, sums, alpha), alpha, target.background)
    photo = photo_over(target.photo, target.background)
    loss = objective.loss(
        image, photo, *on_canvas(target.camera.frame, target.mask, photo, kernels.photometric)
    )
    if not view.channels:
        return loss
    # Drawn separately, so that `pull` has the gradient of the photo only, and of few channels.
    seen = unrolled(Seen(replace(view.splats, pull=None), None, target.camera))
    images = geometry.drawn(objective.geometry.outputs, view.channels, seen, kernels)
    known = TrainingView(target.camera, target.landmarks, target.progress)
    return loss + objective.geometry(images, known)


def photo_over(photo: UInt8[Array, "h w c"], background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """Returns a photo as values in [0, 1]; one with alpha is composited over the background."""
    pixels = photo.astype(jnp.float32) / 255
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3]
    return over(pixels[..., :3] * alpha[..., None], alpha, background)
