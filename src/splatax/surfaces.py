"""Surfaces of a scene in one view: the plane of each Gaussian, and the normals of a depth image.

Along the ray of a pixel, the density of a 3D Gaussian is highest at one point (Yu et al. 2024, GOF). Near
the mean, these points lie on a plane with the normal Sigma^-1 r, where r is the ray through the mean (Zhang
et al. 2024, RaDe-GS). A flat Gaussian has its own plane, and a round one a plane that faces the camera.

Through a pinhole, the inverse of the depth of a plane is an affine function of the pixel,

    1 / depth(p) = 1 / depth_i + slope_i . (p - mean2d_i),

and through other lenses it is one to first order. Three ordinary channels therefore carry a plane through
any rasterizer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.splats import MIN_ALPHA, Splats

LEAST_LOG_SCALE = -60.0  # a size that float32 can hold
FLATTEST = -12.0  # log of the ratio of two scales below which flatter Gaussians are treated alike
STEEPEST = 2.0  # standard deviations of inverse depth for one of the drawn ellipse
FARTHEST = 0.9  # fraction of the inverse depth that a plane may lose or gain inside the drawn ellipse


Vector = tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]


class Planes(NamedTuple):
    """The plane of each Gaussian in one view; those of culled rows are finite and have no gradient.

    Attributes:
        disparities: inverse depth by the lens at the mean, 1 / world units.
        slopes: change of the inverse depth with the pixel, x and y.
        normals: unit normals in the world, towards the camera.
        axes: the shortest axes of the Gaussians, unit vectors in the world, towards the camera. They equal
            the normals of flat Gaussians. Those of rounder ones are nearer to the surface's normal, which
            the ray turns towards the camera.
    """

    disparities: Float[Array, " n"]
    slopes: Float[Array, "n 2"]
    normals: Float[Array, "n 3"]
    axes: Float[Array, "n 3"]


@jax.jit
def planes(gaussians: Gaussians, camera: Camera, splats: Splats) -> Planes:
    """Returns the planes on which the density of each Gaussian along rays is highest.

    A plane that is seen edge-on has no finite slope, and the low-pass makes the ellipse of a small Gaussian
    larger than its plane. Slopes are therefore limited: over the drawn ellipse, the standard deviation of
    the plane's inverse depth is at most twice that of the Gaussian, and the inverse depth stays positive.
    Gaussians that span at least a third of a pixel down their slope keep their exact plane. Those that are
    drawn along rays (`splatax.along_rays`) keep it wherever they are drawn, except in their blur.

    Args:
        gaussians: the scene.
        camera: camera of the view.
        splats: the scene in this view, row by row.
    """
    shown = jnp.all(splats.extents > 0, axis=1)
    ahead = camera.position + camera.rotation[2]  # what every lens sees

    def one(shown, mean, quat, log_scale):
        mean, quat = jnp.where(shown, mean, ahead), jnp.where(shown, quat, jnp.eye(4, dtype=quat.dtype)[0])
        log_scale = jnp.where(shown, jnp.maximum(log_scale, LEAST_LOG_SCALE), 0)  # -inf is exactly flat
        return _plane(camera, mean, quat, log_scale)

    def limit(shown, plane, sqrt_conic, opacity, blur):
        opacity = jnp.where(shown, opacity, 1)
        sqrt_conic = jnp.where(shown, sqrt_conic, jnp.array([1, 0, 1], sqrt_conic.dtype))
        disparity, (x, y), spread = plane
        factor = _limit(disparity, (x, y), spread, sqrt_conic, opacity, blur)
        return factor * x, factor * y

    blurs = None if splats.slants is None else 1 / splats.slants[:, 5]
    inclined, normals, axes = jax.vmap(one)(shown, gaussians.means, gaussians.quats, gaussians.log_scales)
    # Without barriers, the compiler repeats the whole computation for each number that is stacked below.
    inclined = jax.lax.optimization_barrier(inclined)
    slopes = jax.vmap(limit)(shown, inclined, splats.sqrt_conics, splats.opacities, blurs)
    stacked = (jax.lax.optimization_barrier(rows) for rows in (slopes, normals, axes))
    return Planes(inclined[0], *(jnp.stack(rows, axis=1) for rows in stacked))


def _plane(camera: Camera, mean: Float[Array, "3"], quat: Float[Array, "4"], log_scale: Float[Array, "3"]):
    """Returns one plane with the Gaussian's standard deviation of inverse depth, its normal, and its axis.

    Vectors are tuples of numbers, because CPUs multiply thousands of small matrices slowly.
    """

    def seen(point):
        local = camera.to_camera(point)
        x, y = camera.to_pixel(local)
        return x, y, 1 / camera.lens.depth(local)

    (_, _, disparity), push = jax.linearize(seen, mean)
    first, second, third = (push(direction) for direction in jnp.eye(3, dtype=mean.dtype))
    x, y, near = zip(first, second, third, strict=True)
    # Columns of the inverse of the Jacobian, up to a factor: how the point moves if x, y or nearness grows.
    along = _cross(y, near), _cross(near, x), _cross(x, y)
    sign = jnp.sign(_dot(near, along[2]))
    facing = _times(sign / jnp.sqrt(_dot(along[2], along[2])), along[2])
    axes, sizes = _axes(quat), tuple(log_scale)
    least = jax.lax.stop_gradient(jnp.minimum(jnp.minimum(sizes[0], sizes[1]), sizes[2]))
    turned = [  # a factor of Sigma does not change the plane
        _times(jnp.exp(2 * jnp.maximum(least - size, FLATTEST)) * _dot(axis, facing), axis)
        for size, axis in zip(sizes, axes, strict=True)
    ]
    normal = _sum(*turned)
    down = _dot(normal, along[2])
    slope = -_dot(normal, along[0]) / down, -_dot(normal, along[1]) / down
    spreads = [_dot(near, axis) * jnp.exp(size) for size, axis in zip(sizes, axes, strict=True)]
    spread = jnp.sqrt(spreads[0] ** 2 + spreads[1] ** 2 + spreads[2] ** 2)
    thin = _where(sizes[0] <= least, axes[0], _where(sizes[1] <= least, axes[1], axes[2]))
    towards = jnp.where(_dot(thin, facing) < 0, -1, 1).astype(mean.dtype)
    unit_normal = _times(1 / jnp.sqrt(_dot(normal, normal)), normal)
    return (disparity, slope, spread), unit_normal, _times(towards, thin)


def _axes(quat: Float[Array, "4"]) -> tuple[Vector, Vector, Vector]:
    """Returns the columns of the rotation of a quaternion of any length; zero gives the identity."""
    w, x, y, z = quat
    squared = w * w + x * x + y * y + z * z
    positive = squared > 0
    f = jnp.where(positive, 2 / jnp.where(positive, squared, 1), 0)
    return (
        (1 - f * (y * y + z * z), f * (x * y + w * z), f * (x * z - w * y)),
        (f * (x * y - w * z), 1 - f * (x * x + z * z), f * (y * z + w * x)),
        (f * (x * z + w * y), f * (y * z - w * x), 1 - f * (x * x + y * y)),
    )


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Vector, b: Vector) -> Float[Array, ""]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(factor: Float[Array, ""], a: Vector) -> Vector:
    return factor * a[0], factor * a[1], factor * a[2]


def _sum(a: Vector, b: Vector, c: Vector) -> Vector:
    return a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]


def _where(mask: Bool[Array, ""], a: Vector, b: Vector) -> Vector:
    return jnp.where(mask, a[0], b[0]), jnp.where(mask, a[1], b[1]), jnp.where(mask, a[2], b[2])


def _limit(
    disparity: Float[Array, ""],
    slope: tuple[Float[Array, ""], Float[Array, ""]],
    spread: Float[Array, ""],
    sqrt_conic: Float[Array, "3"],
    opacity: Float[Array, ""],
    blur: Float[Array, ""] | None,
) -> Float[Array, ""]:
    """Returns the factor, at most 1, by which a slope is reduced; see `planes`.

    `blur` is the variance of a splat that is drawn along rays, and None for an ellipse, which has it inside.
    """
    u, v, w = sqrt_conic
    first = slope[0] / u
    second = (slope[1] - v * first) / w
    squared = first * first + second * second
    sloped = squared > 0
    blurred = squared if blur is None else (slope[0] * slope[0] + slope[1] * slope[1]) * blur
    drawn = jnp.sqrt(jnp.where(sloped, blurred, 1))  # deviation of the plane over the drawn ellipse
    reach = jnp.sqrt(jnp.maximum(2 * jnp.log(jnp.maximum(opacity / MIN_ALPHA, 1)), 1e-6))
    most = jnp.minimum(STEEPEST * spread, FARTHEST * disparity / reach)
    return jnp.where(sloped, jnp.minimum(most / drawn, 1), 1)


@jax.jit
def positions_of(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Returns the world points that a camera sees at the centres of its pixels.

    Args:
        camera: of the depth's size.
        depth: by the lens, world units.
    """

    def one(pixel, depth):
        here = camera
        if camera.motion is not None:
            here = camera.at(camera.motion.time(pixel, *camera.size))
        return here.rotation.T @ (here.to_point(pixel, depth) - here.translation)

    return jax.vmap(jax.vmap(one))(pixel_centers(camera.width, camera.height, depth.dtype), depth)


@jax.jit
def normals_of(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Returns the normals of a depth image: unit vectors in the world, towards the camera.

    They are cross products of central differences of the points that the camera sees, one-sided at the
    border. They are 0 where the pixel or one of its neighbours has no depth.

    Args:
        camera: of the depth's size.
        depth: by the lens, world units; 0 where it is unknown.
    """
    known = depth > 0
    points = positions_of(camera, jnp.where(known, depth, 1))
    right, left = _beside(points, 1, 1), _beside(points, 1, -1)
    below, above = _beside(points, 0, 1), _beside(points, 0, -1)
    around = (
        known & _beside(known, 1, 1) & _beside(known, 1, -1) & _beside(known, 0, 1) & _beside(known, 0, -1)
    )
    return unit(jnp.where(around[..., None], jnp.cross(below - above, right - left), 0))


def _beside(values: Array, axis: int, by: int) -> Array:
    """Returns the values of the next pixels along an axis, and those of the border itself there."""
    size = values.shape[axis]
    return jnp.take(values, jnp.clip(jnp.arange(size) + by, 0, size - 1), axis=axis)


def unit(vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns vectors of length one; zero ones stay zero, with a zero gradient."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    some = squared > 0
    return jnp.where(some, vectors / jnp.sqrt(jnp.where(some, squared, 1)), 0)


def pixel_centers(width: int, height: int, dtype: jnp.dtype) -> Float[Array, "h w 2"]:
    """Returns the coordinates of the centres of an image's pixels."""
    x, y = (jnp.arange(size, dtype=dtype) + 0.5 for size in (width, height))
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
