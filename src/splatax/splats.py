"""`Splats`, the 2D Gaussians of one view, which connect projection and rasterization.

Projection computes them from a scene and a camera, and a rasterizer draws them. Density control uses their
cotangent, the gradient of the loss with respect to the splats.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.pytrees import pytree
from splatax.shapes import check_arrays, check_size

MIN_ALPHA = 1 / 255  # below one 8-bit level a splat is not drawn
MAX_ALPHA = 0.99  # keeps 1 - alpha invertible in backward passes
NO_BLUR = 1e30  # inverse variance of a blur that is smaller than any splat
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished before the splat that would take it lower
# (all three from the authors' code of Kerbl et al. 2023)


@pytree
@dataclass(frozen=True)
class Splats:
    """2D Gaussians in pixels; the first pixel's centre is at (0.5, 0.5).

    The alpha of splat i at pixel p, with d = p - means2d[i] and (u, v, w) = sqrt_conics[i], is

        min(0.99, opacities[i] exp(-q / 2)),   q = (u dx + v dy)^2 + (w dy)^2,   0 where below 1/255.

    With (gx, gy, a, b, c, f) = slants[i], q is exact in perspective, and the splat never smaller than a blur:

        q = min(((u dx + v dy)^2 + (w dy)^2) / (m^2 + a dx^2 + 2 b dx dy + c dy^2), f (dx^2 + dy^2))

    with m = 1 + gx dx + gy dy, and without the first of the two where m <= 0; see `splatax.along_rays`.

    Attributes:
        means2d: centres, x right, y down, pixels.
        sqrt_conics: triangular square root of the inverse covariance, 1 / pixels.
        depths: depth by the lens (camera z, unless it maps angles), world units.
        extents: half width and height, pixels, of the box outside which alpha is 0. Zero means
            culled: not drawn, with a zero gradient.
        colors: display-referred RGB, at least 0.
        opacities: alpha at the mean, in [0, 1].
        width, height: image size, pixels (static).
        pull: None, or zeros to request a gradient that means2d does not have: the sums over pixels of |dL/dx|
            and |dL/dy|, in which contributions of opposite sign do not cancel. The value does not affect the
            image.
        period: pixels after which the image repeats sideways, as a panorama does; None if it does not. What
            reaches over one side is drawn at the other too.
        slants: None, or how the plane of each splat lies in perspective. The relative change of its inverse
            depth with the pixel, 1 / pixels; three numbers of its thickness, 0 for a disc, 1 / pixels^2; and
            the inverse variance of the blur, 1 / pixels^2, which has no gradient.
        sort_keys: None, or numbers without a gradient by which splats are drawn, such as distances; None for
            the depths. The least is drawn first, ties in their order here.
    """

    means2d: Float[Array, "n 2"]
    sqrt_conics: Float[Array, "n 3"]
    depths: Float[Array, " n"]
    extents: Float[Array, "n 2"]
    colors: Float[Array, "n 3"]
    opacities: Float[Array, " n"]
    width: int = field(metadata={"static": True})
    height: int = field(metadata={"static": True})
    pull: Float[Array, "n 2"] | None = None
    period: Float[Array, ""] | None = None
    slants: Float[Array, "n 6"] | None = None
    sort_keys: Float[Array, " n"] | None = None


def checked(splats: Splats, channels: Float[Array, "n c"] | None = None) -> Splats:
    """Checks that the arrays of splats and the channels to blend fit together, and returns the splats.

    It checks only shapes and dtypes, so it works on traced arrays.

    Raises:
        ValueError: if a shape or dtype is wrong, or the image has no size.
    """
    arrays = {
        "means2d": (splats.means2d, "n 2"),
        "sqrt_conics": (splats.sqrt_conics, "n 3"),
        "depths": (splats.depths, "n"),
        "extents": (splats.extents, "n 2"),
        "colors": (splats.colors, "n 3"),
        "opacities": (splats.opacities, "n"),
    }
    if splats.pull is not None:
        arrays["pull"] = (splats.pull, "n 2")
    if splats.period is not None:
        arrays["period"] = (splats.period, "")
    if splats.slants is not None:
        arrays["slants"] = (splats.slants, "n 6")
    if splats.sort_keys is not None:
        arrays["sort_keys"] = (splats.sort_keys, "n")
    if channels is not None:
        arrays["channels"] = (channels, "n c")
    check_arrays("Splats", arrays)
    check_size("Splats", splats.width, splats.height)
    return splats


def joined(views: Sequence[Splats]) -> Splats:
    """Returns the splats of several scenes in one view, one scene after another.

    The views must have one size and one period, and all or none of them sort keys.
    """
    first, period = views[0], views[0].period
    if any(splats.slants is not None for splats in views):
        views = [replace(splats, slants=slants_of(splats)) for splats in views]
    rows = [replace(splats, period=None) for splats in views]
    return replace(
        first if len(views) == 1 else jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *rows),
        period=period,
    )


def for_kernels(splats: Splats) -> Splats:
    """Returns splats as kernels take them, which draw by depths and do not read sort keys."""
    if splats.sort_keys is None:
        return splats
    return replace(splats, depths=jax.lax.stop_gradient(splats.sort_keys), sort_keys=None)


def slants_of(splats: Splats) -> Float[Array, "n 6"]:
    """Returns the slants of splats; those of ellipses face the camera, without a blur."""
    if splats.slants is not None:
        return splats.slants
    return jnp.zeros((len(splats.depths), 6), splats.means2d.dtype).at[:, 5].set(NO_BLUR)


def unrolled(splats: Splats, channels: Float[Array, "n c"]) -> tuple[Splats, Float[Array, "m c"]]:
    """Returns splats without a period, and their channels: each has a copy on the other side of the seam.

    The copies follow the n splats, in the same order. Without a period, nothing changes.
    """
    if splats.period is None:
        return splats, channels
    means2d, extents = splats.means2d, splats.extents
    right = means2d[:, 0] > splats.width / 2
    moved = means2d[:, 0] + jnp.where(right, -1, 1) * splats.period
    reaches = (moved + extents[:, 0] > 0) & (moved - extents[:, 0] < splats.width)
    copies = replace(
        splats,
        means2d=jnp.stack([moved, means2d[:, 1]], axis=1),
        extents=jnp.where(reaches[:, None], extents, 0),
        period=None,
    )
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), replace(splats, period=None), copies)
    return both, jnp.concatenate([channels, channels])
