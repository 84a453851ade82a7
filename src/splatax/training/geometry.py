"""Regularizers that make Gaussians lie on surfaces: penalties on what a training view shows of geometry.

    spread        sqrt(E[w^2] - E[w]^2) / E[w]    how far the planes of the Gaussians at a pixel lie apart
    consistency   1 - E[n] . N                    whether their normals agree with that of the depth image
    points        |z_known E[w] - 1|              whether the depth is that of the known points

E is the mean over the Gaussians at a pixel, weighted like colour; w the inverse depth of a Gaussian's plane
at the pixel, n its normal, and N the normal of the depth image 1 / E[w].

All three saturate: an error e counts as e / (1 + e / limit). Edges of objects, thin, rough and transparent
objects, and wrong points have large errors that no scene can avoid, and get small gradients.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.protocol import Kernels
from splatax.cameras import Camera
from splatax.drawn import Drawn, Seen, planes_of, unrolled
from splatax.outputs import Output
from splatax.pipeline import composite
from splatax.surface_outputs import from_middle, surface_channels, surface_depth
from splatax.surfaces import normals_of
from splatax.training.canvases import mean_over
from splatax.training.objectives import TrainingView

GROWTH = 0.1  # fraction of the run in which penalties that begin late reach their weights
LEAST_VARIANCE = 1e-8  # of relative depth, below which float32 cannot tell it from zero


@dataclass(frozen=True)
class NoGeometry:
    """Draws nothing and adds no penalty."""

    @property
    def outputs(self) -> Mapping[str, Output]:
        """No outputs."""
        return {}

    @property
    def after(self) -> float:
        """The start of the run."""
        return 0.0

    def __call__(self, images: Mapping[str, Any], seen: TrainingView) -> Float[Array, ""]:
        """Returns zero."""
        return jnp.zeros(())


@dataclass(frozen=True)
class Surfaces:
    """Penalizes depth spread, inconsistent normals and wrong depths of landmarks. A weight of 0 omits a part.

    Attributes:
        spread: weight of the standard deviation of inverse depth along each ray, relative to its mean.
        consistency: weight of 1 minus the cosine between the Gaussians' normals and that of the depth image
            (Huang et al. 2024, Eq. 14). Its gradient is rounded differently on other numbers of devices.
        points: weight of the relative error of inverse depth at landmarks.
        spread_limit: spread to which a larger one tends in the penalty, see `saturated`.
        consistency_limit: 1 minus the cosine to which a larger one tends in the penalty.
        points_limit: relative error of inverse depth to which a larger one tends in the penalty.
        after: fraction of the run, below 1, before which the penalties are zero. They grow from there to
            their weights within a tenth of the run, or until its end. Real captures keep more of their PSNR
            than with weaker penalties from the start.

    Raises:
        ValueError: if `after` is not from 0 to below 1.
    """

    spread: float = 0.04
    consistency: float = 0.15
    points: float = 0.6
    spread_limit: float = 0.05
    consistency_limit: float = 0.02
    points_limit: float = 0.01
    after: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.after < 1:
            raise ValueError(
                f"penalties begin after a fraction of the run from 0 to below 1, not {self.after}"
            )

    @property
    def outputs(self) -> Mapping[str, Output]:
        """The outputs that the parts with a weight need."""
        if not (self.spread or self.consistency or self.points):
            return {}
        needed = {"layers": LAYERS if self.spread else ONE_LAYER}
        if self.consistency:
            needed["facing"] = FACING
        return needed

    def __call__(self, images: Mapping[str, Any], seen: TrainingView) -> Float[Array, ""]:
        """Returns the sum of the penalties; see `splatax.training.protocols.Geometry`."""
        depth, spread, _ = images["layers"]
        penalty = self.spread * mean_over(saturated(spread, self.spread_limit), seen.camera)
        if self.consistency:
            limit = self.consistency_limit
            penalty += self.consistency * inconsistency(images["facing"], depth, seen.camera, limit=limit)
        if self.points and seen.landmarks is not None:
            penalty += self.points * error_at(seen.landmarks, depth, seen.camera, limit=self.points_limit)
        if not self.after:
            return penalty
        return penalty * jnp.clip((seen.progress - self.after) / min(GROWTH, 1 - self.after), 0, 1)


def saturated(error: Float[Array, "*shape"], limit: float) -> Float[Array, "*shape"]:
    """Returns e / (1 + e / limit) for errors e: about e if it is small, and at most the limit.

    The slope is 1 at zero, 1 / 4 at the limit, and 1 / 100 at nine times the limit.

    Args:
        error: errors of at least zero.
        limit: in the unit of the errors; infinity returns them as they are.
    """
    return error / (1 + error / limit)


def inconsistency(
    facing: Float[Array, "h w 4"], depth: Float[Array, "h w"], camera: Camera, *, limit: float = math.inf
) -> Float[Array, ""]:
    """Returns the mean of alpha (1 - E[n] . N), where N is the normal of the depth image.

    Pixels beside one that shows nothing, for which N does not exist, do not count.

    Args:
        facing: sums of weighted normals, and alpha.
        depth: depth by the lens, world units; 0 where nothing is.
        camera: of the view.
        limit: to which the value of a pixel tends, see `saturated`.
    """
    normal = normals_of(camera, depth)
    exists = jnp.any(normal != 0, axis=-1)
    cosine = jnp.sum(facing[..., :3] * normal, axis=-1)
    return mean_over(jnp.where(exists, saturated(facing[..., 3] - cosine, limit), 0), camera)


def error_at(
    landmarks: Float[Array, "k 3"], depth: Float[Array, "h w"], camera: Camera, *, limit: float = math.inf
) -> Float[Array, ""]:
    """Returns the mean relative error of inverse depth at points that the view shows.

    Inverse depth is interpolated between the centres of pixels, which is exact on a plane through a pinhole.

    Args:
        landmarks: world points; rows that are not finite stand for none.
        depth: depth by the lens, world units; 0 where nothing is.
        camera: of the view.
        limit: to which the error of a point tends, see `saturated`.
    """
    ahead = camera.position + camera.rotation[2]
    width, height = camera.size

    def one(point):
        known = jnp.all(jnp.isfinite(point))
        point = jnp.where(known, point, ahead)
        seen = known & camera.lens.sees(camera.rotation @ point + camera.translation)
        local = camera.to_camera(jnp.where(seen, point, ahead))
        x, y = camera.to_pixel(local) - 0.5  # in pixels from the centre of the first
        left, top = jnp.floor(x), jnp.floor(y)
        inside = seen & (left >= 0) & (top >= 0) & (left < width - 1) & (top < height - 1)
        row, column = (jnp.where(inside, number, 0).astype(jnp.int32) for number in (top, left))
        corners = jax.lax.dynamic_slice(depth, (row, column), (2, 2))
        counts = inside & jnp.all(corners > 0)
        across, down = x - left, y - top
        weights = jnp.outer(jnp.stack([1 - down, down]), jnp.stack([1 - across, across]))
        error = camera.lens.depth(local) * jnp.sum(weights / jnp.where(counts, corners, 1)) - 1
        return jnp.where(counts, saturated(jnp.abs(error), limit), 0), counts

    errors, counts = jax.vmap(one)(landmarks)
    return jnp.sum(errors) / jnp.maximum(jnp.sum(counts), 1)


class Layers(NamedTuple):
    """Depth of the blended planes at each pixel, and how far they lie apart.

    Attributes:
        depth: the output "surface_depth"; 0 where nothing is.
        spread: alpha times the standard deviation of the planes' inverse depth, relative to its mean.
        scatter: the sum over pairs of planes of both weights and the squared difference of inverse depths,
            relative to the square of their mean. The mean has no gradient: what is near the camera would
            otherwise pull everything behind it towards itself.
    """

    depth: Float[Array, "h w"]
    spread: Float[Array, "h w"]
    scatter: Float[Array, "h w"]


def _moments(seen: Seen) -> Float[Array, "n 9"]:
    """Returns the planes a + x p + y q of each Gaussian, and the six coefficients of their squares."""
    a, x, y = surface_channels(seen).T
    return jnp.stack([a, x, y, a * a, 2 * a * x, 2 * a * y, x * x, 2 * x * y, y * y], axis=1)


def _layers(drawn: Drawn) -> Layers:
    assert drawn.sums is not None
    assert drawn.alpha is not None
    p, q = jnp.moveaxis(from_middle(drawn.splats, drawn.sums.dtype), -1, 0)
    powers = jnp.stack([jnp.ones_like(p), p, q, p * p, p * q, q * q], axis=-1)
    first = jnp.sum(drawn.sums[..., :3] * powers[..., :3], axis=-1)
    second = jnp.sum(drawn.sums[..., 3:] * powers, axis=-1)
    covered = (drawn.alpha > 0) & (first > 0)
    mean = jnp.where(covered, first, 1)
    # The standard deviation has an infinite slope at zero.
    ratio = jnp.maximum(second * drawn.alpha / (mean * mean) - 1, 0) + LEAST_VARIANCE
    spread = jnp.where(covered, drawn.alpha * jnp.sqrt(ratio), 0)
    depth = jnp.where(covered, drawn.alpha / mean, 0)
    scatter = jnp.maximum(second * drawn.alpha - first * first, 0) * jnp.square(jax.lax.stop_gradient(depth))
    return Layers(depth, spread, scatter)


def _one_layer(drawn: Drawn) -> Layers:
    depth = surface_depth(drawn)
    return Layers(depth, jnp.zeros_like(depth), jnp.zeros_like(depth))


def _normals(seen: Seen) -> Float[Array, "n 3"]:
    # Those of the planes, not the shortest axes: round Gaussians are penalized too, and become flat.
    return planes_of(seen, "facing").normals


def _normals_and_alpha(drawn: Drawn) -> Float[Array, "h w 4"]:
    assert drawn.sums is not None
    assert drawn.alpha is not None
    return jnp.concatenate([drawn.sums, drawn.alpha[..., None]], axis=-1)


def channels(outputs: Mapping[str, Output], seen: Seen) -> dict[str, Float[Array, "n _"]]:
    """Returns what the outputs blend, by their names; nothing if there are none."""
    if not outputs:
        return {}
    painted = unrolled(seen)
    return {name: output.channels(painted) for name, output in outputs.items() if output.channels}


def drawn(
    outputs: Mapping[str, Output], channels: Mapping[str, Float[Array, "n _"]], seen: Seen, kernels: Kernels
) -> dict[str, Any]:
    """Returns the outputs by their names.

    Args:
        outputs: made of blended channels only.
        channels: channels of the outputs, by name.
        seen: the painted splats and the camera.
        kernels: kernels that blend the channels.
    """
    ends = np.cumsum([values.shape[1] for values in channels.values()])
    stacked = jnp.concatenate(list(channels.values()), axis=1)
    sums, alpha = composite(seen.splats, stacked, kernels)
    view = Drawn(None, alpha, None, seen, jnp.zeros(3, sums.dtype))
    return {
        name: outputs[name].finish(view._replace(sums=part))
        for name, part in zip(channels, jnp.split(sums, ends[:-1], axis=2), strict=True)
    }


LAYERS = Output(_layers, _moments)
ONE_LAYER = Output(_one_layer, surface_channels)
FACING = Output(_normals_and_alpha, _normals)
