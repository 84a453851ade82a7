"""Which Gaussians to keep: those that are sound, inside a shape, seen, or that matter most."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from splatax import backends
from splatax.camera import Camera
from splatax.gaussians import Gaussians
from splatax.math.neighbours import mean_squared_distances
from splatax.projection import Dilation, LowPass
from splatax.rendering import render
from splatax.splats import MIN_ALPHA

NEIGHBOURS = 16  # that tell how lonely a Gaussian is
FLOATER_DEVIATIONS = 5.0  # of the logarithm of its distance to them, by the median deviation
FLOATER_FACTOR = 4.0  # of the median distance, at least: corners of a dense scene are lonely by 2
REACH = 3.0  # standard deviations that a Gaussian is seen to
TO_SIGMA = 1.4826  # from a median absolute deviation to the standard deviation of a normal
LEAST_WEIGHT = 0.02  # pixels, over all views, that a Gaussian must fill to count as seen


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, world units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points are inside, or on the border."""
        return np.all((points >= np.array(self.low)) & (points <= np.array(self.high)), axis=1)


@dataclass(frozen=True)
class Sphere:
    """A ball, world units."""

    centre: tuple[float, float, float]
    radius: float

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points are inside, or on the border."""
        return np.linalg.norm(points - np.array(self.centre), axis=1) <= self.radius


def crop(gaussians: Gaussians, shape: Box | Sphere) -> Gaussians:
    """Those whose centre is inside a shape."""
    return _keep(gaussians, shape.contains(np.asarray(gaussians.means)))


def clean(
    gaussians: Gaussians,
    *,
    min_opacity: float = MIN_ALPHA,
    deviations: float = FLOATER_DEVIATIONS,
    weights: Float[np.ndarray, " n"] | None = None,
) -> tuple[Gaussians, dict[str, int]]:
    """Without what is broken, too faint to be drawn, floats alone, or was seen by no camera.

    Args:
        gaussians: the scene.
        min_opacity: fainter ones go.
        deviations: a Gaussian floats if the logarithm of its distance to its 16 nearest exceeds
            the median by so many (robust) standard deviations, the distance is 4 times usual, and
            it does not reach them: large ones fill a sparse background.
        weights: of `visible_weights`; without, all count as seen.

    Returns:
        What is left, and how many went for which reason, the first that applied.
    """
    leaves = [np.asarray(leaf).reshape(len(gaussians), -1) for leaf in jax.tree.leaves(gaussians)]
    # Flat Gaussians have log scales of -inf, which is sound.
    finite = np.all([(np.isfinite(leaf) | np.isneginf(leaf)).all(axis=1) for leaf in leaves], axis=0)
    finite &= np.isfinite(np.asarray(gaussians.means)).all(axis=1)
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
    """The `count` Gaussians that matter most, in their order.

    Args:
        gaussians: the scene.
        count: how many to keep; all, if there are fewer.
        weights: how much each matters, such as `visible_weights`. Without: opacity times the area
            of its largest cross section.
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
    *,
    low_pass: LowPass = Dilation(),
    backend: str = backends.AUTO,
) -> Float[np.ndarray, " n"]:
    """How many pixels each Gaussian fills in views: the sum of its blending weights.

    A channel's image is the sum of weight times channel, so the gradient of its sum is the weight.
    """

    def total(channel, camera):
        return jnp.sum(
            render(gaussians, camera, features=channel, low_pass=low_pass, backend=backend).features
        )

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
    lonely = distances > median + max(deviations * spread, np.log(FLOATER_FACTOR))
    return lonely & (REACH * sizes < np.exp(distances))


def _keep(gaussians: Gaussians, mask: Bool[np.ndarray, " n"]) -> Gaussians:
    return jax.tree.map(lambda leaf: leaf[mask], gaussians)
