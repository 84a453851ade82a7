"""One training step: renders a view, compares it with its photo, and moves the Gaussians."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from splatax import backends
from splatax.backends.protocol import Photometric
from splatax.cameras import Camera
from splatax.drawn import Seen, unrolled
from splatax.gaussians import Gaussians
from splatax.losses import photometric_on_canvas
from splatax.low_pass import LowPass
from splatax.outputs import over
from splatax.splats import Splats, joined
from splatax.stages import composite, project
from splatax.training import geometry
from splatax.training.feed import Batch
from splatax.training.moving import Pace, Rows, moved
from splatax.training.objectives import TrainingView
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
        weights: of the weights of photos.
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
    weights: Any
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
    return _train_step(state, batch, recipe.optimizer.rates, recipe.sh.openings(recipe.steps), recipe)


@partial(jax.jit, static_argnames="recipe", donate_argnames="state")
def _train_step(
    state: TrainState,
    batch: Batch,
    learning_rates: LearningRates,
    openings: Float[Array, " bands"],
    recipe: Recipe,
) -> tuple[TrainState, Float[Array, ""]]:
    background_key, noise_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    loss, splats, d = compare(state, batch, recipe, recipe.drawing.background.sample(background_key))

    good = jnp.isfinite(loss)  # if not, nothing moves
    progress = state.step / state.total
    living = jnp.sum(state.gaussians.opacity_logits > -jnp.inf)
    reach = recipe.optimizer.reach(splats.depths, state.extent)
    rows = Rows(state.gaussians, d.gaussians, state.opt_state, reach)
    pace = Pace(learning_rates, openings, progress, good, living, state.extent)
    gaussians, opt_state = moved(rows, pace, noise_key, recipe)
    total = state.total.astype(jnp.float32)
    learned = (
        recipe.density.observe(state.density_state, *filling(splats, d.splats, batch.camera.frame)),
        recipe.appearance.update(state.appearance, batch.source, d.appearance, progress, total),
        recipe.camera_refinement.update(state.cameras, batch.source, d.camera, progress, total),
        recipe.objective.weights.update(state.weights, batch.source.view, loss),
    )
    return advanced(replace(state, gaussians=gaussians, opt_state=opt_state), learned, good), loss


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


def filling(splats: Splats, d_splats: Splats, frame: Float[Array, "2"] | None) -> tuple[Splats, Splats]:
    """Returns the splats of a view on a canvas, and their gradients, as if the view filled the canvas.

    Density control then finds the sizes and the gradients, as fractions of the image, that the view has by
    itself. Extents are scaled by the longer sides of view and canvas.

    Args:
        splats: the 2D Gaussians of the view.
        d_splats: gradient of the loss with respect to them.
        frame: of the camera; None if the view fills its image.
    """
    if frame is None:
        return splats, d_splats
    canvas = jnp.array([splats.width, splats.height], frame.dtype)
    scale = (canvas / frame)[None]
    larger = replace(
        splats,
        means2d=splats.means2d * scale,
        extents=splats.extents * (jnp.max(canvas) / jnp.max(frame)),
    )
    pull = None if d_splats.pull is None else d_splats.pull / scale
    return larger, replace(d_splats, means2d=d_splats.means2d / scale, pull=pull)


def filtered(low_pass: LowPass, divisor: int) -> LowPass:
    """Returns the filter for photos that are smaller by `divisor`.

    It keeps its size in pixels of the full photo, so that smaller photos do not blur the scene.
    """
    return replace(low_pass, variance=low_pass.variance / divisor**2)


class Gradients(NamedTuple):
    """Gradients of one view's loss."""

    gaussians: Gaussians
    splats: Splats
    appearance: Any  # with respect to the photo's appearance parameters
    camera: Any  # with respect to the photo's camera parameters


def compare(
    state: TrainState, batch: Batch, recipe: Recipe, background: Float[Array, "3"]
) -> tuple[Float[Array, ""], Splats, Gradients]:
    """Returns the loss of a view, its splats, and the gradients of the loss times the weight of the photo."""

    def project_view(gaussians, correction):
        camera = recipe.camera_refinement(correction, batch.camera, state.extent)
        return shown(gaussians, camera, recipe, batch.divisor), camera

    appearance = recipe.appearance.for_photo(state.appearance, batch.source)
    correction = recipe.camera_refinement.for_photo(state.cameras, batch.source)
    view, pull_back, camera = jax.vjp(project_view, state.gaussians, correction, has_aux=True)
    progress = state.step / state.total
    weight = recipe.objective.weights.of_photo(state.weights, batch.source.view, progress)
    context = surroundings(batch.context, camera, recipe, batch.divisor)
    target = Target(batch.photo, batch.mask, batch.landmarks, background, camera, progress, weight, context)
    (_, loss), (d_view, d_appearance) = jax.value_and_grad(weighted_loss, argnums=(0, 1), has_aux=True)(
        view, appearance, target, recipe
    )
    d_gaussians, d_camera = pull_back(d_view)
    return loss, view.splats, Gradients(d_gaussians, d_view.splats, d_appearance, d_camera)


class Shown(NamedTuple):
    """The part of a view that is drawn: its splats, and channels that the geometry penalty blends."""

    splats: Splats
    channels: dict[str, Float[Array, "m _"]]


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


def surroundings(context: Gaussians | None, camera: Camera, recipe: Recipe, divisor: int) -> Shown | None:
    """Projects the context of a view, see `Batch`, as `shown` does; None if there is none."""
    return None if context is None else shown(context, camera, recipe, divisor)


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

    return Shown(joined([view.splats, context.splats]), {name: both(name) for name in view.channels})


def shown(gaussians: Gaussians, camera: Camera, recipe: Recipe, divisor: int) -> Shown:
    """Projects a scene, or a part of it, for a photo that is smaller by `divisor`."""
    low_pass = filtered(recipe.drawing.low_pass, divisor)
    kernels = backends.resolve(recipe.drawing.backend)
    splats = project(gaussians, camera, low_pass=low_pass, backend=kernels)
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
    kernels, objective = backends.resolve(recipe.drawing.backend), recipe.objective
    sums, alpha = composite(view.splats, view.splats.colors, backend=kernels)
    image = over(recipe.appearance(appearance, sums, alpha), alpha, target.background)
    photo = photo_over(target.photo, target.background)
    loss = objective.loss(image, photo, *counted(target, kernels.photometric))
    if not view.channels:
        return loss
    # Drawn apart, so that `pull` tells what the photo misses, and kernels need not know it of so many.
    seen = unrolled(Seen(replace(view.splats, pull=None), None, target.camera))
    images = geometry.drawn(objective.geometry.outputs, view.channels, seen, kernels)
    known = TrainingView(target.camera, target.landmarks, target.progress)
    return loss + objective.geometry(images, known)


def counted(target: Target, kernel: Photometric) -> tuple[Bool[Array, "h w"] | None, Photometric]:
    """Returns the mask of what counts in the loss, and the kernel of the loss for it.

    On a canvas, only the frame counts, and windows end at its border.
    """
    frame = target.camera.frame
    if frame is None:
        return target.mask, kernel
    height, width = target.photo.shape[:2]
    columns, rows = (
        jnp.arange(side, dtype=frame.dtype) + 0.5 < end
        for side, end in zip((width, height), frame, strict=True)
    )
    mask = rows[:, None] & columns[None]
    if target.mask is not None:
        mask &= target.mask
    return mask, partial(photometric_on_canvas, frame=frame, kernel=kernel)


def photo_over(photo: UInt8[Array, "h w c"], background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """Returns a photo as values in [0, 1]; one with alpha is composited over the background."""
    pixels = photo.astype(jnp.float32) / 255
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3]
    return over(pixels[..., :3] * alpha[..., None], alpha, background)
