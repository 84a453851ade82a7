"""`Splats`, the 2D Gaussians of one view, which connect projection and rasterization.

Projection computes them from a scene and a camera, and a rasterizer draws them. Density control uses their
cotangent, the gradient of the loss with respect to the splats.
"""

from dataclasses import dataclass, field

import jax
from jaxtyping import Array, Float

from splatax.shapes import check_arrays, check_size

MIN_ALPHA = 1 / 255  # below one 8-bit level a splat is not drawn
MAX_ALPHA = 0.99  # keeps 1 - alpha invertible in backward passes
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished before the splat that would take it lower
# (all three from the authors' code of Kerbl et al. 2023)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Splats:
    """2D Gaussians in pixels; the first pixel's centre is at (0.5, 0.5).

    The alpha of splat i at pixel p, with d = p - means2d[i] and (u, v, w) = sqrt_conics[i], is

        min(0.99, opacities[i] exp(-((u dx + v dy)^2 + (w dy)^2) / 2)),   0 where below 1/255.

    Attributes:
        means2d: centres, x right, y down, pixels.
        sqrt_conics: triangular square root of the inverse covariance, 1 / pixels.
        depths: camera z, world units; nearest is drawn first, ties in their order here.
        extents: half width and height, pixels, of the box outside which alpha is 0. Zero means
            culled: not drawn, with a zero gradient.
        colors: display-referred RGB, at least 0.
        opacities: alpha at the mean, in [0, 1].
        width, height: image size, pixels (static).
        pull: None, or zeros to request a gradient that means2d does not have: the sums over pixels of |dL/dx|
            and |dL/dy|, in which contributions of opposite sign do not cancel. The value does not affect the
            image.
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
    if channels is not None:
        arrays["channels"] = (channels, "n c")
    check_arrays("Splats", arrays)
    check_size("Splats", splats.width, splats.height)
    return splats
