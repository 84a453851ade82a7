"""EWA projection of 3D Gaussians to the 2D Gaussians of one view.

    Sigma' = J W Sigma W^T J^T + 0.3 I         (Zwicker et al. 2001; Kerbl et al. 2023, Eq. 5)

W is the camera's rotation and J the Jacobian of the perspective at the mean. The code keeps the
2 x 3 factor J W R S instead of Sigma: see `math.ellipsoids`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians, is_sound
from splatax.low_pass import LowPass
from splatax.math import ellipsoids, harmonics
from splatax.splats import MIN_ALPHA, Splats

NEAR = 0.01  # world units of camera z; nearer is culled (as gsplat does)
MAX_SLOPE = 1e6  # |x / z| beyond which the perspective of a mean overflows; culled
MAX_LOG_SCALE = 40.0  # e^40 squared still fits float32
FRUSTUM_MARGIN = 0.3  # of half the image: margin up to which J follows the mean (as in gsplat)


class Projected(NamedTuple):
    """Row of `Splats` for one Gaussian."""

    mean2d: Float[Array, "2"]
    sqrt_conic: Float[Array, "3"]
    depth: Float[Array, ""]
    extent: Float[Array, "2"]
    color: Float[Array, "3"]
    opacity: Float[Array, ""]


def project(gaussians: Gaussians, camera: Camera, low_pass: LowPass) -> Splats:
    """Projects all Gaussians to one view. This portable kernel defines the results of all other kernels.

    A row is culled if the Gaussian is nearer than `NEAR`, less opaque than 1/255, outside the image, too
    large for float32 or broken (see `gaussians.is_sound`). Culled rows have zero extent and a zero gradient,
    and do not affect the gradient of the camera; their other numbers are finite.

    Args:
        gaussians: n Gaussians.
        camera: camera of the view.
        low_pass: filter against aliasing.

    Returns:
        n splats in the same order.
    """
    position = camera.position

    def one(mean, quat, log_scale, logit, sh):
        return project_one(mean, quat, log_scale, logit, sh, camera, position, low_pass)

    rows = jax.vmap(one)(*jax.tree.leaves(gaussians))
    return Splats(
        means2d=rows.mean2d,
        sqrt_conics=rows.sqrt_conic,
        depths=rows.depth,
        extents=jax.lax.stop_gradient(rows.extent),
        colors=rows.color,
        opacities=rows.opacity,
        width=camera.width,
        height=camera.height,
    )


def project_one(
    mean: Float[Array, "3"],
    quat: Float[Array, "4"],
    log_scale: Float[Array, "3"],
    logit: Float[Array, ""],
    sh: Float[Array, "k 3"],
    camera: Camera,
    position: Float[Array, "3"],
    low_pass: LowPass,
) -> Projected:
    """Projects one Gaussian; `position` is the camera's, computed once for all of them."""
    # Operands are replaced before use, so that culled rows do not propagate NaN in the backward pass.
    sound = is_sound(mean, quat, log_scale, logit, sh)
    mean, quat, log_scale, logit, sh = (
        jnp.where(sound, field, 0) for field in (mean, quat, log_scale, logit, sh)
    )
    point = camera.to_camera(mean)
    in_front = sound & (point[2] > NEAR) & jnp.isfinite(point[2])
    in_front &= jnp.all(jnp.abs(point[:2]) < MAX_SLOPE * point[2])
    point = jnp.where(in_front, point, jnp.array([0, 0, 1], point.dtype))
    mean2d = camera.to_pixel(point)

    scale = jnp.exp(jnp.minimum(log_scale, MAX_LOG_SCALE))
    factor = perspective_jacobian(point, camera) @ camera.rotation @ ellipsoids.covariance_factor(quat, scale)
    usable = in_front & jnp.isfinite(jnp.sum(jnp.square(jnp.sum(factor * factor))))
    factor = jnp.where(usable, factor, 0)
    blurred = ellipsoids.determinant_of_rows(factor, jnp.asarray(low_pass.variance, factor.dtype))
    sharp = ellipsoids.determinant_of_rows(factor, jnp.zeros((), factor.dtype))
    usable &= blurred > 0  # without a low-pass, a Gaussian can be too thin for its dtype
    blurred = jnp.where(usable, blurred, 1)
    a, c = jnp.where(usable, jnp.sum(factor * factor, axis=1) + low_pass.variance, 1)
    covariance = jnp.array([a, factor[0] @ factor[1], c])

    opacity = jax.nn.sigmoid(logit) * low_pass.fade(sharp, blurred)
    reach = 2 * jnp.log(jnp.maximum(opacity / MIN_ALPHA, 1))  # squared sigmas at which alpha is 1/255
    extent = jnp.sqrt(reach * jnp.array([a, c]))
    color = harmonics.evaluate(sh, direction(position, mean, usable)) + 0.5
    usable &= jnp.all(jnp.isfinite(color))
    visible = usable & (opacity >= MIN_ALPHA) & overlaps_image(mean2d, extent, camera)
    return Projected(
        mean2d,
        ellipsoids.sqrt_conic(covariance, blurred),
        point[2],
        jnp.where(visible, extent, 0),
        jnp.maximum(jnp.where(usable, color, 0), 0),
        opacity,
    )


def perspective_jacobian(point: Float[Array, "3"], camera: Camera) -> Float[Array, "2 3"]:
    """Returns d pixel / d point; a point beside the frustum is clamped to the frustum's margin.

    Beside the frustum J becomes very large, and a single splat would cover the whole image.
    """
    x, y, z = point
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height
    slope_x = jnp.clip(
        x / z, -(camera.cx + margin_x) / camera.fx, (camera.width - camera.cx + margin_x) / camera.fx
    )
    slope_y = jnp.clip(
        y / z, -(camera.cy + margin_y) / camera.fy, (camera.height - camera.cy + margin_y) / camera.fy
    )
    fx, fy, zero = camera.fx / z, camera.fy / z, jnp.zeros_like(z)
    return jnp.array([[fx, zero, -fx * slope_x], [zero, fy, -fy * slope_y]])


def overlaps_image(mean2d: Float[Array, "2"], extent: Float[Array, "2"], camera: Camera) -> Bool[Array, ""]:
    """Returns whether the box of a splat overlaps the image."""
    size = jnp.array([camera.width, camera.height], mean2d.dtype)
    return jnp.all((mean2d + extent > 0) & (mean2d - extent < size))


def direction(
    position: Float[Array, "3"], mean: Float[Array, "3"], usable: Bool[Array, ""]
) -> Float[Array, "3"]:
    """Returns the unit vector from the camera to a Gaussian; zero, with zero gradient, if they coincide."""
    offset = jnp.where(usable, mean - position, 0)
    squared = offset @ offset
    apart = squared > 0
    return jnp.where(apart, offset / jnp.sqrt(jnp.where(apart, squared, 1)), 0)
