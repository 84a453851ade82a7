"""Projection of 3D Gaussians to the 2D Gaussians of one view, through any lens.

    Sigma' = J W Sigma W^T J^T + 0.3 I         (Zwicker et al. 2001; Kerbl et al. 2023, Eq. 5)

W is the camera's rotation and J the Jacobian of the lens at the mean; `footprints` has this and the unscented
transform. The code keeps the 2 x 3 factor J W R S instead of Sigma: see `math.ellipsoids`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians, is_sound
from splatax.low_pass import LowPass
from splatax.math import ellipsoids, harmonics
from splatax.splats import MIN_ALPHA, Splats

MAX_LOG_SCALE = 40.0  # e^40 squared still fits float32
FARTHEST = 1e18  # so does its square


class Projected(NamedTuple):
    """Row of `Splats` for one Gaussian."""

    mean2d: Float[Array, "2"]
    sqrt_conic: Float[Array, "3"]
    depth: Float[Array, ""]
    extent: Float[Array, "2"]
    color: Float[Array, "3"]
    opacity: Float[Array, ""]


def project(gaussians: Gaussians, camera: Camera, low_pass: LowPass, method: Method = EWA) -> Splats:
    """Projects all Gaussians to one view. This portable kernel defines the results of all other kernels.

    A row is culled if the lens does not see the Gaussian, in the middle of the exposure too (it is nearer
    than 0.01, or behind a perspective), or it is less opaque than 1/255, outside the image, too large for
    float32 or broken (see `gaussians.is_sound`). Culled rows have zero extent and a zero gradient, and do not
    affect the gradient of the camera; their other numbers are finite.

    Colour is seen along the ray from the camera's position in the middle of the exposure.

    Args:
        gaussians: n Gaussians.
        camera: camera of the view.
        low_pass: filter against aliasing.
        method: way to find footprints.

    Returns:
        n splats in the same order.
    """
    position = camera.position

    def one(mean, quat, log_scale, logit, sh):
        return project_one(mean, quat, log_scale, logit, sh, camera, position, low_pass, method)

    rows = jax.vmap(one)(*jax.tree.leaves(gaussians))
    return splats_of(rows, camera)


def splats_of(rows: Projected, camera: Camera) -> Splats:
    """Returns the splats of projected rows: n of each field. Extents have no gradient."""
    return Splats(
        means2d=rows.mean2d,
        sqrt_conics=rows.sqrt_conic,
        depths=rows.depth,
        extents=jax.lax.stop_gradient(rows.extent),
        colors=rows.color,
        opacities=rows.opacity,
        width=camera.width,
        height=camera.height,
        period=period_of(camera),
    )


def in_order(splats: Splats, gaussians: Gaussians, camera: Camera) -> Splats:
    """Returns the splats of Gaussians, to be drawn in their order.

    Distances are those from the camera in the middle of the exposure. A camera without a centre, such as an
    orthographic one, keeps the order by depth.
    """
    if gaussians.order == "depth" or not camera.lens.CENTRAL:
        return splats
    offsets = jax.lax.stop_gradient(gaussians.means - camera.position[None])
    x, y, z = jnp.clip(jnp.where(jnp.isfinite(offsets), offsets, 0), -FARTHEST, FARTHEST).T
    return replace(splats, sort_keys=jnp.sqrt(x * x + y * y + z * z))


class Placed(NamedTuple):
    """A Gaussian whose numbers are safe to compute with, and its mean as the camera sees it.

    Operands are replaced before use, so that culled rows do not propagate NaN in the backward pass.
    """

    mean: Float[Array, "3"]  # world
    quat: Float[Array, "4"]
    log_scale: Float[Array, "3"]
    logit: Float[Array, ""]
    sh: Float[Array, "k 3"]
    point: Float[Array, "3"]  # the mean in camera axes; if it is not seen, a point that every lens sees
    seen: Bool[Array, ""]  # whether all numbers are valid and the lens sees the mean


def placed(fields: Sequence[Array], camera: Camera, position: Float[Array, "3"]) -> Placed:
    """Returns a Gaussian that is safe to compute with, and where the camera sees it.

    Args:
        fields: mean, quaternion, log scale, opacity logit and SH of one Gaussian.
        camera: camera of the view.
        position: `camera.position`, computed once for all Gaussians.
    """
    sound = is_sound(*fields)
    mean, quat, log_scale, logit, sh = (jnp.where(sound, field, 0) for field in fields)
    point = camera.rotation @ mean + camera.translation
    seen = sound & camera.lens.sees(point)
    ahead = jnp.array([0, 0, 1], point.dtype)
    if camera.motion is not None:
        mean = jnp.where(seen, mean, position + camera.rotation.T @ ahead)
        point = camera.to_camera(mean)
        seen &= camera.lens.sees(point)
    return Placed(mean, quat, log_scale, logit, sh, jnp.where(seen, point, ahead), seen)


def project_one(
    mean: Float[Array, "3"],
    quat: Float[Array, "4"],
    log_scale: Float[Array, "3"],
    logit: Float[Array, ""],
    sh: Float[Array, "k 3"],
    camera: Camera,
    position: Float[Array, "3"],
    low_pass: LowPass,
    method: Method,
) -> Projected:
    """Projects one Gaussian; `position` is the camera's, computed once for all of them."""
    mean, quat, log_scale, logit, sh, point, seen = placed(
        (mean, quat, log_scale, logit, sh), camera, position
    )
    scale = jnp.exp(jnp.minimum(log_scale, MAX_LOG_SCALE))
    found = method(camera, mean, point, ellipsoids.covariance_factor(quat, scale))
    usable = seen & found.usable & jnp.isfinite(jnp.sum(jnp.square(jnp.sum(found.rows * found.rows))))
    rows = jnp.where(usable, found.rows, 0)
    variance = jnp.asarray(low_pass.variance, rows.dtype)
    blurred = ellipsoids.determinant_of_rows(rows, found.weights, variance)
    sharp = ellipsoids.determinant_of_rows(rows, found.weights, jnp.zeros_like(variance))
    usable &= blurred > 0  # without a low-pass, a Gaussian can be too thin for its dtype
    blurred = jnp.where(usable, blurred, 1)
    a, c = jnp.where(usable, jnp.sum(found.weights[None] * rows * rows, axis=1) + low_pass.variance, 1)
    covariance = jnp.array([a, jnp.sum(found.weights * rows[0] * rows[1]), c])

    opacity = jax.nn.sigmoid(logit) * low_pass.fade(sharp, blurred)
    reach = 2 * jnp.log(jnp.maximum(opacity / MIN_ALPHA, 1))  # squared sigmas at which alpha is 1/255
    extent = jnp.sqrt(reach * jnp.array([a, c]))
    ray = direction(position, mean, usable) if camera.lens.CENTRAL else camera.rotation[2]
    color = harmonics.evaluate(sh, ray) + 0.5
    usable &= jnp.all(jnp.isfinite(color))
    visible = usable & (opacity >= MIN_ALPHA) & overlaps_image(found.mean2d, extent, camera)
    return Projected(
        found.mean2d,
        ellipsoids.sqrt_conic(covariance, blurred),
        camera.lens.depth(point),
        jnp.where(visible, extent, 0),
        jnp.maximum(jnp.where(usable, color, 0), 0),
        opacity,
    )


def period_of(camera: Camera) -> Float[Array, ""] | None:
    """Returns after how many pixels the image repeats sideways; None if it does not."""
    return None if camera.lens.PERIOD is None else camera.lens.PERIOD * camera.fx


def overlaps_image(mean2d: Float[Array, "2"], extent: Float[Array, "2"], camera: Camera) -> Bool[Array, ""]:
    """Returns whether the box of a splat overlaps the image, at its place or a period beside it."""
    size = camera.size
    period = period_of(camera)
    places = [mean2d]
    if period is not None:
        shift = period * jnp.array([1, 0], mean2d.dtype)
        places += [mean2d - shift, mean2d + shift]
    overlaps = [jnp.all((place + extent > 0) & (place - extent < size)) for place in places]
    return jnp.any(jnp.stack(overlaps))


def direction(
    position: Float[Array, "3"], mean: Float[Array, "3"], usable: Bool[Array, ""]
) -> Float[Array, "3"]:
    """Returns the unit vector from the camera to a Gaussian; zero, with zero gradient, if they coincide."""
    offset = jnp.where(usable, mean - position, 0)
    squared = offset @ offset
    apart = squared > 0
    return jnp.where(apart, offset / jnp.sqrt(jnp.where(apart, squared, 1)), 0)
