"""Surfaces of a scene in one view: the plane of each Gaussian, and the normals of a depth image.

Along the ray of a pixel, the density of a 3D Gaussian is highest at one point (Yu et al. 2024, GOF). Near
the mean, these points lie on a plane with the normal Sigma^-1 r, where r is the ray through the mean (Zhang
et al. 2024, RaDe-GS). A flat Gaussian has its own plane, and a round one a plane that faces the camera.

Through a pinhole, the inverse of the depth of a plane is an affine function of the pixel,

    1 / depth(p) = 1 / depth_i + slope_i . (p - mean2d_i),

and through other lenses it is one to first order. Three ordinary channels therefore carry a plane through
any rasterizer.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.math import quaternions
from splatax.splats import MIN_ALPHA, Splats

LEAST_LOG_SCALE = -60.0  # a size that float32 can hold
FLATTEST = -12.0  # log of the ratio of two scales below which flatter Gaussians are treated alike
STEEPEST = 2.0  # standard deviations of inverse depth for one of the drawn ellipse
FARTHEST = 0.9  # fraction of the inverse depth that a plane may lose or gain inside the drawn ellipse


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


class PlaneRows(NamedTuple):
    """The numbers that planes depend on, one row for each Gaussian. Those of culled rows may be anything.

    Attributes:
        places: changes of the pixel, x and y, and of the inverse depth with the point in the world.
        disparities: inverse depth by the lens at the mean.
        quats, log_scales: of the Gaussians.
        sqrt_conics, opacities: of the splats.
        blurs: variances of the blur of splats that are drawn along rays, pixels^2; no rows for ellipses,
            which contain it.
        extents: of the splats; zero for culled rows.
    """

    places: Float[Array, "n 3 3"]
    disparities: Float[Array, " n"]
    quats: Float[Array, "n 4"]
    log_scales: Float[Array, "n 3"]
    sqrt_conics: Float[Array, "n 3"]
    opacities: Float[Array, " n"]
    blurs: Float[Array, " b"] | None
    extents: Float[Array, "n 2"]


Found = tuple[Float[Array, "n 2"], Float[Array, "n 3"], Float[Array, "n 3"]]  # slopes, normals, axes


@partial(jax.jit, static_argnames="find")
def planes(
    gaussians: Gaussians, camera: Camera, splats: Splats, find: Callable[[PlaneRows], Found] | None = None
) -> Planes:
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
        find: kernel that computes the planes of rows; None for `planes_of_rows`.
    """
    shown = jnp.all(splats.extents > 0, axis=1)
    ahead = camera.position + camera.rotation[2]  # what every lens sees
    means = jnp.where(shown[:, None], gaussians.means, ahead[None])
    places, disparities = jax.vmap(lambda mean: _placed(camera, mean))(means)
    rows = PlaneRows(
        places=places,
        disparities=disparities,
        quats=gaussians.quats,
        log_scales=gaussians.log_scales,
        sqrt_conics=splats.sqrt_conics,
        opacities=splats.opacities,
        blurs=disparities[:0] if splats.slants is None else 1 / splats.slants[:, 5],
        extents=splats.extents,
    )
    return Planes(disparities, *(planes_of_rows if find is None else find)(rows))


def planes_of_rows(rows: PlaneRows) -> Found:
    """Returns the slopes, normals and shortest axes of rows; see `Planes`."""

    def one(row: PlaneRows):
        shown = jnp.all(row.extents > 0)
        quat = jnp.where(shown, row.quats, jnp.eye(4, dtype=row.quats.dtype)[0])
        log_scale = jnp.where(shown, jnp.maximum(row.log_scales, LEAST_LOG_SCALE), 0)  # -inf is exactly flat
        opacity = jnp.where(shown, row.opacities, 1)
        sqrt_conic = jnp.where(shown, row.sqrt_conics, jnp.array([1, 0, 1], row.sqrt_conics.dtype))
        slope, normal, axis, spread = _plane(row.places, quat, log_scale)
        limit = _limit(row.disparities, slope, spread, sqrt_conic, opacity, row.blurs)
        return slope * limit, normal, axis

    if rows.blurs is not None and not len(rows.blurs):
        rows = rows._replace(blurs=None)
    return jax.vmap(one)(rows)


def _placed(camera: Camera, mean: Float[Array, "3"]) -> tuple[Float[Array, "3 3"], Float[Array, ""]]:
    """Returns how the pixel and the inverse depth of a point change with the point, and the latter."""

    def seen(point):
        local = camera.to_camera(point)
        near = 1 / camera.lens.depth(local)
        return jnp.append(camera.to_pixel(local), near), near

    return jax.jacfwd(seen, has_aux=True)(mean)


def _plane(across: Float[Array, "3 3"], quat: Float[Array, "4"], log_scale: Float[Array, "3"]):
    """Returns one plane, and the Gaussian's standard deviation of inverse depth."""
    x, y, near = across
    # Columns of the inverse of the Jacobian, up to a factor: how the point moves if x, y or nearness grows.
    along = jnp.cross(y, near), jnp.cross(near, x), jnp.cross(x, y)
    facing = along[2] * jnp.sign(jnp.sum(near * along[2])) / jnp.linalg.norm(along[2])
    axes = quaternions.to_rotation(quat)
    least = jax.lax.stop_gradient(jnp.min(log_scale))  # a factor of Sigma does not change the plane
    precision = jnp.exp(2 * jnp.maximum(least - log_scale, FLATTEST))
    normal = axes @ (precision * (axes.T @ facing))
    slope = -jnp.stack([normal @ along[0], normal @ along[1]]) / (normal @ along[2])
    spread = jnp.linalg.norm((near @ axes) * jnp.exp(log_scale))
    axis = axes[:, jnp.argmin(log_scale)]
    axis = jnp.where(axis @ facing < 0, -axis, axis)
    return slope, normal / jnp.linalg.norm(normal), axis, spread


def _limit(
    disparity: Float[Array, ""],
    slope: Float[Array, "2"],
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
    blurred = squared if blur is None else jnp.sum(slope * slope) * blur
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
    border. They are 0 where the pixel or one of its neighbours has no depth. On a canvas, the border is that
    of the camera's frame.

    Args:
        camera: of the depth's size.
        depth: by the lens, world units; 0 where it is unknown.
    """
    known = depth > 0
    width, height = camera.width, camera.height
    if camera.frame is not None:
        width, height = jnp.round(camera.frame).astype(jnp.int32)
    points = positions_of(camera, jnp.where(known, depth, 1))

    def neighbours(values):
        return (*_beside(values, 1, width), *_beside(values, 0, height))

    right, left, below, above = neighbours(points)
    around = jnp.all(jnp.stack([known, *neighbours(known)]), axis=0)
    return unit(jnp.where(around[..., None], jnp.cross(below - above, right - left), 0))


def _beside(values: Array, axis: int, end: int | Array) -> tuple[Array, Array]:
    """Returns the values of the next and of the previous pixels along an axis. A border pixel gets its own.

    The values are slices, because the gradient of a gather is slower.
    """
    first, last = (jax.lax.slice_in_dim(values, i, j, axis=axis) for i, j in ((0, 1), (-1, None)))
    rest, most = (jax.lax.slice_in_dim(values, i, j, axis=axis) for i, j in ((1, None), (0, -1)))
    places = jnp.arange(values.shape[axis], dtype=jnp.int32)
    inside = jnp.expand_dims(places < end - 1, [i for i in range(values.ndim) if i != axis])
    following = jnp.where(inside, jnp.concatenate([rest, last], axis=axis), values)
    return following, jnp.concatenate([first, most], axis=axis)


def unit(vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns vectors of length one; zero ones stay zero, with a zero gradient."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    some = squared > 0
    return jnp.where(some, vectors / jnp.sqrt(jnp.where(some, squared, 1)), 0)


def pixel_centers(width: int, height: int, dtype: jnp.dtype) -> Float[Array, "h w 2"]:
    """Returns the coordinates of the centres of an image's pixels."""
    x, y = (jnp.arange(size, dtype=dtype) + 0.5 for size in (width, height))
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
