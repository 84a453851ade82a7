"""The outputs of surfaces: depth and normals of the planes of the Gaussians; see `splatax.surfaces`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.drawn import Drawn, Seen, planes_of, selection_of
from splatax.splats import Splats
from splatax.surfaces import pixel_centers, unit


def surface_channels(seen: Seen) -> Float[Array, "n 3"]:
    """Returns the plane of each Gaussian, as its inverse depth at the image's centre and its slope.

    The channels are those of `splatax.surfaces.planes`. Blended, they give the plane at a pixel.

    Raises:
        ValueError: if there are only splats, which do not have planes.
    """
    found = planes_of(seen, "surface_depth")
    offset = seen.splats.means2d - _middle(seen.splats)[None]
    return jnp.column_stack([found.disparities - jnp.sum(found.slopes * offset, axis=1), found.slopes])


def surface_depth(drawn: Drawn) -> Float[Array, "h w"]:
    """Returns the depth of the blended planes at each pixel: a harmonic mean; 0 where there is none."""
    assert drawn.sums is not None
    assert drawn.alpha is not None
    offset = from_middle(drawn.splats, drawn.sums.dtype)
    disparity = drawn.sums[..., 0] + jnp.sum(drawn.sums[..., 1:] * offset, axis=-1)
    covered = (drawn.alpha > 0) & (disparity > 0)
    return jnp.where(covered, drawn.alpha / jnp.where(covered, disparity, 1), 0)


def median_surface_depth(drawn: Drawn) -> Float[Array, "h w"]:
    """Returns the depth of the plane of the Gaussian that makes a pixel half opaque; 0 where none does."""
    splats, median = drawn.splats, selection_of(drawn).median
    found = planes_of(drawn.seen, "median_surface_depth")
    rows = jnp.column_stack([splats.means2d, found.disparities, found.slopes])
    rows = jnp.pad(rows, [(0, 1), (0, 0)])  # so that index -1 is no splat
    mean2d, disparity, slope = jnp.split(rows[median], (2, 3), axis=-1)
    offset = pixel_centers(splats.width, splats.height, rows.dtype) - mean2d
    if splats.period is not None:  # the copy on this side of the seam
        turns = jnp.round(offset[..., 0] / splats.period)
        offset = offset.at[..., 0].add(-turns * splats.period)
    disparity = disparity[..., 0] + jnp.sum(slope * offset, axis=-1)
    met = disparity > 0
    return jnp.where(met, 1 / jnp.where(met, disparity, 1), 0)


def normal_channels(seen: Seen) -> Float[Array, "n 3"]:
    """Returns the shortest axis of each Gaussian, a unit vector in the world towards the camera.

    Raises:
        ValueError: if there are only splats, which do not have them.
    """
    return planes_of(seen, "normals").axes


def normals(drawn: Drawn) -> Float[Array, "h w 3"]:
    """Returns the mean of the shortest axes at each pixel, as a unit vector; 0 where there is none."""
    assert drawn.sums is not None
    return unit(drawn.sums)


def from_middle(splats: Splats, dtype: jnp.dtype) -> Float[Array, "h w 2"]:
    """Returns the offsets of pixels from the image's middle, to which `surface_channels` refer."""
    return pixel_centers(splats.width, splats.height, dtype) - _middle(splats)[None, None]


def _middle(splats: Splats) -> Float[Array, "2"]:
    return jnp.array([splats.width / 2, splats.height / 2], splats.means2d.dtype)
