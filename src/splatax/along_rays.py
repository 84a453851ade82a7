"""Gaussians drawn along the ray of each pixel: the response of ray-exact 3D Gaussians and of discs.

With the mean m in camera axes and the inverse covariance B^T B, the largest density of a Gaussian along the
ray of direction x has the squared distance

    q(x) = |Bx X Bm|^2 / |Bx|^2 .

Both forms are homogeneous in x, so x may be any point of the ray. The points m + E d stand for pixels at the
offset d from the image of the mean, where E is the inverse of the lens's Jacobian across the ray. In d,

    q(d) = d^T Q d / ((1 + g . d)^2 + d^T H d),   Q^-1 = J Sigma J^T,

    g = (BE)^T Bm / |Bm|^2,   H = (BE)^T BE / |Bm|^2 - g g^T .

Q is therefore the ellipse of the lens's linear approximation (`footprints.Ewa` without a low-pass), g the
slant of the Gaussian's plane, and H its thickness. A flat Gaussian has H = 0 and is a disc: q is then the
squared distance of the point where the ray meets its plane, as by the homography of Huang et al. 2024, Eq.
10, and the inverse depth of this point is (1 + g . d) / z.

This is exact for pinholes and where rays are parallel. Other lenses, and cameras that move during the
exposure, are replaced around each mean by the pinhole with the same Jacobian: perspective is exact, and the
curvature of the lens over one Gaussian is ignored.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays
from splatax.math import ellipsoids, harmonics, quaternions
from splatax.projection import MAX_LOG_SCALE, Projected, direction, overlaps_image, placed, splats_of
from splatax.splats import MIN_ALPHA, Splats

FLATTEST = -20.0  # log of the ratio of two scales below which flatter Gaussians are treated alike
THINNEST = 1e-3  # pixels: standard deviation of an image below which only the blur is drawn
LEAST_BOUND = 1e-3  # eigenvalues up to this are those of a splat that is not bounded
MARGIN = 1.001  # for rounding: what is lost beyond it is below 1/255 by less than a hundredth
EVERYWHERE = 1e20  # reach of a splat that is not bounded: the camera is inside it


class Slanted(NamedTuple):
    """Rows of `Splats` for one Gaussian drawn along rays."""

    row: Projected
    slant: Float[Array, "6"]


def squared_distances(
    offsets: Float[Array, "n 2"], sqrt_conics: Float[Array, "n 3"], slants: Float[Array, "n 6"]
) -> Float[Array, " n"]:
    """Returns q of slanted splats at offsets from their means; see `Splats`."""
    dx, dy = offsets.T
    u, v, w = sqrt_conics.T
    gx, gy, a, b, c, floor = slants.T
    ahead = 1 + gx * dx + gy * dy
    across = jnp.square(u * dx + v * dy) + jnp.square(w * dy)
    along = ahead * ahead + a * dx * dx + 2 * b * dx * dy + c * dy * dy
    blur = jax.lax.stop_gradient(floor) * (dx * dx + dy * dy)
    met = (ahead > 0) & (across < blur * along)
    return jnp.where(met, across / jnp.where(met, along, 1), blur)


class Bounds(NamedTuple):
    """The ellipse (u dx + v dy)^2 + (w dy)^2 <= reach outside which alpha is 0, apart from the blur."""

    offsets: Float[Array, "n 2"]  # of its centre from the mean, pixels
    sqrt_conics: Float[Array, "n 3"]
    reach: Float[Array, " n"]


def bounds(
    sqrt_conics: Float[Array, "n 3"], slants: Float[Array, "n 6"], opacities: Float[Array, " n"]
) -> Bounds:
    """Returns the ellipses that hold all offsets at which slanted splats reach an alpha of 1/255.

    In y = U d, where q = |y|^2 / ((1 + s . y)^2 + y^T T y), they are the ellipses

        |y|^2 - r^2 ((s . y)^2 + y^T T y) - 2 r^2 s . y <= r^2,

    unless the Gaussian reaches behind the camera within r standard deviations: it is then unbounded.
    """
    u, v, w = sqrt_conics.T
    gx, gy, a, b, c, _ = slants.T
    squared = 2 * jnp.log(jnp.maximum(opacities / MIN_ALPHA, 1))
    x, y = -v / (u * w), 1 / w  # d of y = (0, 1); that of (1, 0) is (1 / u, 0)
    s, t = gx / u, gx * x + gy * y
    xx = 1 - squared * (s * s + a / (u * u))
    xy = -squared * (s * t + (a * x + b * y) / u)
    yy = 1 - squared * (t * t + a * x * x + 2 * b * x * y + c * y * y)
    determinant = xx * yy - xy * xy
    bounded = (xx > LEAST_BOUND) & (yy > LEAST_BOUND) & (determinant > LEAST_BOUND)
    one, none = jnp.ones_like(xx), jnp.zeros_like(xx)
    xx, yy, determinant = (jnp.where(bounded, value, one) for value in (xx, yy, determinant))
    xy, s, t = (jnp.where(bounded, value, none) for value in (xy, s, t))
    first = squared * (yy * s - xy * t) / determinant
    second = squared * (xx * t - xy * s) / determinant
    reach = jnp.where(bounded, MARGIN * squared * (1 + s * first + t * second), EVERYWHERE)
    root = jnp.sqrt(xx)
    conics = jnp.stack([root * u, root * v + xy / root * w, jnp.sqrt(determinant / xx) * w], axis=1)
    return Bounds(jnp.stack([first / u + second * x, second * y], axis=1), conics, reach)


def extents(
    sqrt_conics: Float[Array, "n 3"], slants: Float[Array, "n 6"], opacities: Float[Array, " n"]
) -> Float[Array, "n 2"]:
    """Returns half widths and heights of the boxes around means outside which alpha is 0, pixels."""
    found = bounds(sqrt_conics, slants, opacities)
    u, v, w = found.sqrt_conics.T
    half = jnp.stack([jnp.sqrt(1 + (v / w) ** 2) / u, 1 / w], axis=1) * jnp.sqrt(found.reach)[:, None]
    blur = jnp.sqrt(2 * jnp.log(jnp.maximum(opacities / MIN_ALPHA, 1)) / slants[:, 5])
    return jnp.maximum(jnp.abs(found.offsets) + half, blur[:, None])


def project(gaussians: Gaussians, camera: Camera, low_pass: AlongRays, method: Method = EWA) -> Splats:
    """Projects all Gaussians to one view, to be drawn along rays. Rules of culling are those of `project`.

    Raises:
        ValueError: if another method than `Ewa` is asked for.
    """
    if method != EWA:
        raise ValueError(
            f"projection is {method}, which does not apply to the filter AlongRays: it is exact without one. "
            "Leave the projection out, or draw with low_pass=Dilation()."
        )
    position = camera.position

    def one(mean, quat, log_scale, logit, sh):
        return _one(mean, quat, log_scale, logit, sh, camera, position, low_pass)

    rows, slants = jax.vmap(one)(*jax.tree.leaves(gaussians))
    return replace(splats_of(rows, camera), slants=slants)


def _one(
    mean: Float[Array, "3"],
    quat: Float[Array, "4"],
    log_scale: Float[Array, "3"],
    logit: Float[Array, ""],
    sh: Float[Array, "k 3"],
    camera: Camera,
    position: Float[Array, "3"],
    low_pass: AlongRays,
) -> Slanted:
    """Projects one Gaussian; `position` is the camera's, computed once for all of them."""
    mean, quat, log_scale, logit, sh, point, seen = placed(
        (mean, quat, log_scale, logit, sh), camera, position
    )
    axes = quaternions.to_rotation(quat)
    scale = jnp.exp(jnp.minimum(log_scale, MAX_LOG_SCALE))
    jacobian = jax.jacfwd(camera.lens.project)(point) * camera.focal[:, None]
    world = camera.rotation if camera.motion is None else jax.jacfwd(camera.to_camera)(mean)
    rows = jacobian @ world @ (axes * scale[None])
    seen &= jnp.isfinite(jnp.sum(jnp.square(jnp.sum(rows * rows))))
    conic, resolved = _ellipse(jnp.where(seen, rows, 0))
    slant = _slant(camera, point, jacobian, camera.rotation @ axes, log_scale, resolved)
    floor = jnp.full(1, 1 / low_pass.variance, slant.dtype)
    slant = jnp.concatenate([slant, floor])

    opacity = jax.nn.sigmoid(logit)
    extent = extents(conic[None], slant[None], opacity[None])[0]
    ray = direction(position, mean, seen) if camera.lens.CENTRAL else camera.rotation[2]
    color = harmonics.evaluate(sh, ray) + 0.5
    usable = seen & jnp.all(jnp.isfinite(color))
    mean2d = camera.to_pixel(point)
    visible = usable & (opacity >= MIN_ALPHA) & overlaps_image(mean2d, extent, camera)
    row = Projected(
        mean2d,
        conic,
        camera.lens.depth(point),
        jnp.where(visible, extent, 0),
        jnp.maximum(jnp.where(usable, color, 0), 0),
        opacity,
    )
    return Slanted(row, slant)


def _ellipse(rows: Float[Array, "2 3"]) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Returns the root of the inverse covariance, and whether the ellipse is thick enough to be drawn.

    A thinner one, such as a disc that is seen edge-on, gets a round dot below the size of any blur.
    """
    ones, zero = jnp.ones(3, rows.dtype), jnp.zeros((), rows.dtype)
    determinant = ellipsoids.determinant_of_rows(rows, ones, zero)
    a, c = jnp.sum(rows * rows, axis=1)
    resolved = determinant > THINNEST**2 * (a + c)
    covariance = jnp.stack([a, jnp.sum(rows[0] * rows[1]), c])
    dot = jnp.array([THINNEST**2, 0, THINNEST**2], rows.dtype)
    conic = ellipsoids.sqrt_conic(
        jnp.where(resolved, covariance, dot), jnp.where(resolved, determinant, THINNEST**4)
    )
    return conic, resolved


def _slant(
    camera: Camera,
    point: Float[Array, "3"],
    jacobian: Float[Array, "2 3"],
    axes: Float[Array, "3 3"],
    log_scale: Float[Array, "3"],
    resolved: Bool[Array, ""],
) -> Float[Array, "5"]:
    """Returns g and H = (a, b; b, c) of the module's equations; zeros where rays are parallel."""
    if not camera.lens.CENTRAL:
        return jnp.zeros(5, point.dtype)
    # E: offsets move the point by the inverse of the Jacobian, at its depth.
    right, down = jacobian
    onward = jax.grad(camera.lens.depth)(point)
    sideways = jnp.stack([jnp.cross(down, onward), jnp.cross(onward, right)], axis=1)
    volume = jnp.sum(right * sideways[:, 0])
    across = sideways / jnp.where(resolved, volume, 1)
    largest, least = (jax.lax.stop_gradient(f(log_scale)) for f in (jnp.max, jnp.min))
    flattest = jnp.maximum(largest, -MAX_LOG_SCALE) + FLATTEST
    factor = jnp.exp(jnp.maximum(least, flattest) - jnp.maximum(log_scale, flattest))
    inverse = factor[:, None] * axes.T  # B, up to a factor
    center, sides = inverse @ point, inverse @ across
    squared = jnp.sum(center * center)
    squared = jnp.where(resolved, squared, 1)
    slope = (sides.T @ center) / squared
    rest = sides - center[:, None] * slope[None]  # across the center: H is a sum of squares
    thickness = (
        jnp.stack([rest[:, 0] @ rest[:, 0], rest[:, 0] @ rest[:, 1], rest[:, 1] @ rest[:, 1]]) / squared
    )
    return jnp.where(resolved, jnp.concatenate([slope, thickness]), 0)
