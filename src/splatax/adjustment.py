"""Scores with the pose of each photo adjusted on a finished scene, beside those with the given poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera
from splatax.cameras.geometry import seen_at
from splatax.dataset import View, by_photo, mask_of
from splatax.evaluation import Scores, evaluate, photo_of
from splatax.gaussians import Gaussians
from splatax.lpips import Lpips
from splatax.math import rigid
from splatax.pytrees import pytree
from splatax.rendering import Renderer

PROTOCOL = (
    "the pose of each photo is first adjusted to that photo, by least squares over its pixels from the given "
    "pose on; the scene stays as it is. Scores with given poses are lower by what errors of these cost"
)
STEPS = 20  # of Levenberg and Marquardt at most, for each photo
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e3  # relative to the diagonal of the normal equations
ENOUGH = 1e-4  # relative fall of the squared error, below which a step is the last


@dataclass(frozen=True)
class Adjusted:
    """A view with the pose that fits its photo best, and how far its picture moved.

    Attributes:
        view: the view with its adjusted camera.
        motion: median distance between the positions of the scene's Gaussians in the two images, pixels.
    """

    view: View
    motion: float


@dataclass(frozen=True)
class AdjustedScores:
    """Scores of views with adjusted poses.

    Attributes:
        scores: of the views, in their order.
        motions: how far the picture of each photo moved, pixels; see `Adjusted`.
    """

    scores: Scores
    motions: tuple[float, ...]

    @property
    def motion(self) -> float:
        """Median motion over the views, pixels."""
        return float(np.median(self.motions))


def evaluate_adjusted(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    renderer: Renderer = Renderer(),
    lpips: Lpips | None = None,
) -> AdjustedScores:
    """Scores a scene as `splatax.evaluate` does, but with the pose of each view adjusted to its own photo.

    These scores show how well the scene can look like the photos. They are not scores of new views: each
    pose has seen its photo. Report them beside the scores with given poses, and say which is which.

    Args:
        gaussians: the scene. It is not changed.
        views: with photos, such as the held-out ones of a capture.
        renderer: with the background and the low-pass filter of the scene.
        lpips: the metric to compute as well; None for none.

    Raises:
        DatasetError: if a photo is too small to be compared, or its mask leaves too little of it.
    """
    found = adjusted(gaussians, views, renderer)
    scores = evaluate(gaussians, [each.view for each in found], renderer=renderer, lpips=lpips)
    motions = by_photo(views, {each.view.name: each.motion for each in found})
    return AdjustedScores(scores, tuple(float(np.mean(each)) for each in motions.values()))


def adjusted(
    gaussians: Gaussians, views: Sequence[View], renderer: Renderer = Renderer()
) -> tuple[Adjusted, ...]:
    """Finds the pose of each view for which the rendering is most like its photo.

    Each pose depends only on the scene and its own photo. The search is a Levenberg-Marquardt fit, from the
    given pose, with the exact Jacobian of the rendering. Each step lowers the squared error, so PSNR does not
    fall except by rounding. The search is local: errors of more than a few pixels may remain. Masked pixels
    do not count.

    Args:
        gaussians: the scene.
        views: with photos, such as the held-out ones of a capture.
        renderer: with the background and the low-pass filter that the scene is evaluated with.

    Raises:
        DatasetError: if a mask leaves nothing of its photo.
    """
    return tuple(_adjusted(gaussians, view, renderer) for view in views)


def _adjusted(gaussians: Gaussians, view: View, renderer: Renderer) -> Adjusted:
    photo = jnp.asarray(photo_of(view, renderer.behind(view.camera)))
    if isinstance(renderer.background, tuple):
        renderer = replace(renderer, background=jnp.asarray(renderer.background, view.camera.fx.dtype))
    mask = mask_of(view)
    counts = None if mask is None else jnp.asarray(mask)
    camera = view.camera
    damping, system = FIRST_DAMPING, _linearized(gaussians, camera, photo, counts, renderer)
    for _ in range(STEPS):
        moved = _moved(camera, _solved(system, damping))
        following = _linearized(gaussians, moved, photo, counts, renderer)
        if not following.error < system.error:
            damping *= 10
            if damping > MOST_DAMPING:
                break
            continue
        small = system.error - following.error < ENOUGH * system.error
        camera, system, damping = moved, following, damping / 10
        if small:
            break
    return Adjusted(replace(view, camera=camera), picture_motion(gaussians, view.camera, camera))


@pytree
@dataclass(frozen=True)
class Linearized:
    """The squared error of a rendering near a pose, e + 2 g x + x C x for a small twist x in camera axes."""

    error: Float[Array, ""]
    gradient: Float[Array, "6"]
    curvature: Float[Array, "6 6"]


@jax.jit
def _linearized(
    gaussians: Gaussians,
    camera: Camera,
    photo: Array,
    counts: Bool[Array, "h w"] | None,
    renderer: Renderer,
) -> Linearized:
    def rendered(twist: Float[Array, "6"]) -> Float[Array, "h w 3"]:
        rgb = jnp.clip(renderer(gaussians, _moved(camera, twist), outputs=("rgb",)).rgb, 0, 1)
        return rgb if counts is None else jnp.where(counts[..., None], rgb, 0)

    target = photo / 255
    if counts is not None:
        target = jnp.where(counts[..., None], target, 0)
    image, push = jax.linearize(rendered, jnp.zeros(6, camera.fx.dtype))
    columns = lax.map(push, jnp.eye(6, dtype=image.dtype)).reshape(6, -1)
    off = (image - target).reshape(-1)
    with jax.default_matmul_precision("highest"):
        return Linearized(off @ off, columns @ off, columns @ columns.T)


def _solved(system: Linearized, damping: float) -> Float[np.ndarray, "6"]:
    """Returns the Levenberg-Marquardt step, in double precision."""
    curvature, gradient = np.asarray(system.curvature, np.float64), np.asarray(system.gradient, np.float64)
    diagonal = np.diag(curvature)
    damped = curvature + damping * np.diag(np.maximum(diagonal, 1e-12 * max(diagonal.max(), 1e-30)))
    return np.linalg.lstsq(damped, -gradient, rcond=None)[0]


def _moved(camera: Camera, twist: Array | np.ndarray) -> Camera:
    delta = rigid.exponential(jnp.asarray(twist, camera.cam_from_world.dtype))
    with jax.default_matmul_precision("highest"):
        return replace(camera, cam_from_world=delta @ camera.cam_from_world)


def picture_motion(gaussians: Gaussians, before: Camera, after: Camera) -> float:
    """Returns the median distance between the positions of Gaussians in two images of one size, pixels."""
    means, size = np.asarray(gaussians.means), np.array([before.width, before.height])
    (there, far), (here, near) = (seen_at(camera, means) for camera in (before, after))
    both = (far > 0) & (near > 0)
    for pixels in (there, here):
        both &= np.all((pixels >= 0) & (pixels < size), axis=1)
    return float(np.median(np.linalg.norm(here - there, axis=1)[both])) if both.any() else 0.0
