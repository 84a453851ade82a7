"""Selection of Gaussians: by shape, by visibility, by importance, and removal of invalid ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians, broken, rows_of
from splatax.math.neighbours import mean_squared_distances
from splatax.rendering import Renderer
from splatax.splats import MIN_ALPHA

NEIGHBOURS = 16  # nearest neighbours whose distance shows how isolated a Gaussian is
FLOATER_DEVIATIONS = 5.0  # robust standard deviations of the log distance beyond which it is isolated
FLOATER_FACTOR = 4.0  # of the median distance, at least: corners of a dense scene have up to 2
REACH = 3.0  # standard deviations to which a Gaussian is visible
TO_SIGMA = 1.4826  # from the median absolute deviation to the standard deviation of a normal distribution
LEAST_WEIGHT = 0.02  # sum of blending weights over all pixels from which a Gaussian counts as seen


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, world units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns a mask of the points that are inside or on the border."""
        return np.all((points >= np.array(self.low)) & (points <= np.array(self.high)), axis=1)


@dataclass(frozen=True)
class Sphere:
    """A ball, world units."""

    centre: tuple[float, float, float]
    radius: float

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns a mask of the points that are inside or on the border."""
        return np.linalg.norm(points - np.array(self.centre), axis=1) <= self.radius


def crop(gaussians: Gaussians, shape: Box | Sphere) -> Gaussians:
    """Returns the Gaussians whose centre is inside a shape."""
    return _keep(gaussians, shape.contains(np.asarray(gaussians.means)))


def clean(
    gaussians: Gaussians,
    *,
    min_opacity: float = MIN_ALPHA,
    deviations: float = FLOATER_DEVIATIONS,
    weights: Float[np.ndarray, " n"] | None = None,
) -> tuple[Gaussians, dict[str, int]]:
    """Removes Gaussians that are not finite, too faint to be drawn, isolated, or never seen.

    Args:
        gaussians: the scene.
        min_opacity: Gaussians with a lower opacity are removed.
        deviations: a Gaussian is isolated ("floating") if the logarithm of its distance to its 16
            nearest neighbours exceeds the median by this many robust standard deviations, the
            distance is at least 4 times the median, and the Gaussian does not extend to those
            neighbours: large Gaussians in a sparse background are not isolated.
        weights: the result of `visible_weights`; if None, all Gaussians count as seen.

    Returns:
        The remaining Gaussians, and the number removed for each reason (the first that applied).
    """
    finite = ~broken(gaussians)
    visible = np.asarray(gaussians.opacities) >= min_opacity
    seen = np.ones(len(gaussians), bool) if weights is None else weights >= LEAST_WEIGHT
    kept = np.ones(len(gaussians), bool)
    removed = {}
    for reason, good in (("not finite", finite), ("too faint", visible), ("never seen", seen)):
        removed[reason] = int(np.sum(kept & ~good))
        kept &= good
    rows = np.flatnonzero(kept)
    sizes = np.exp(np.asarray(gaussians.log_scales, np.float64)[rows].max(axis=1, initial=-np.inf))
    floating = rows[_floaters(np.asarray(gaussians.means)[rows], sizes, deviations)]
    removed["floating"] = len(floating)
    kept[floating] = False
    return _keep(gaussians, kept), removed


def simplify(
    gaussians: Gaussians, count: int, *, weights: Float[np.ndarray, " n"] | None = None
) -> Gaussians:
    """Returns the `count` most important Gaussians, in their original order.

    Args:
        gaussians: the scene.
        count: number of Gaussians to keep; all are kept if the scene has fewer.
        weights: importance of each Gaussian, such as `visible_weights`. If None, opacity times the
            area of the largest cross section.
    """
    if weights is None:
        two_largest = np.sort(np.asarray(gaussians.log_scales, np.float64), axis=1)[:, 1:].sum(axis=1)
        weights = np.asarray(gaussians.opacities) * np.exp(np.minimum(two_largest, 80))
    best = np.argsort(-weights, kind="stable")[:count]
    mask = np.zeros(len(gaussians), bool)
    mask[best] = True
    return _keep(gaussians, mask)


def visible_weights(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    renderer: Renderer = Renderer(),
) -> Float[np.ndarray, " n"]:
    """Returns the number of pixels that each Gaussian fills in all views: the sum of its blending weights.

    The image of a channel is the sum of weight times channel, so the gradient of the image's sum with
    respect to the channel is the weight.

    Args:
        gaussians: the scene.
        cameras: cameras of the views.
        renderer: with the low-pass filter that the scene was trained with.
    """

    def total(channel, camera):
        return jnp.sum(renderer(gaussians, camera, (), {"weight": channel}).features["weight"])

    channel = jnp.zeros((len(gaussians), 1), gaussians.means.dtype)
    weights = np.zeros(len(gaussians), np.float64)
    for camera in cameras:
        weights += np.asarray(jax.grad(total)(channel, camera))[:, 0]
    return weights


def _floaters(
    means: Float[np.ndarray, "n 3"], sizes: Float[np.ndarray, " n"], deviations: float
) -> Bool[np.ndarray, " n"]:
    if len(means) <= NEIGHBOURS:
        return np.zeros(len(means), bool)
    distances = np.log(np.maximum(mean_squared_distances(means, NEIGHBOURS), 1e-30)) / 2
    median = np.median(distances)
    spread = TO_SIGMA * np.median(np.abs(distances - median))
    isolated = distances > median + max(deviations * spread, np.log(FLOATER_FACTOR))
    return isolated & (REACH * sizes < np.exp(distances))


def _keep(gaussians: Gaussians, mask: Bool[np.ndarray, " n"]) -> Gaussians:
    return rows_of(gaussians, np.flatnonzero(mask))
