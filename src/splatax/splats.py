"""The seam of the pipeline: `Splats`, the 2D Gaussians of one view.

Left of it, a camera decides what is seen; right of it, a rasterizer paints that. The cotangent that crosses
the seam is the signal that density control reads.
"""

from dataclasses import dataclass, field

import jax
from jaxtyping import Array, Float

from splatax.shapes import check_arrays, check_size

MIN_ALPHA = 1 / 255  # below one 8-bit level a splat is not drawn
MAX_ALPHA = 0.99  # keeps 1 - alpha invertible in backward passes
MIN_TRANSMITTANCE = 1e-4  # a pixel is done before the splat that would take it lower
# (all three from the authors' code of Kerbl et al. 2023)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Splats:
    """2D Gaussians in pixels; the first pixel's centre is at (0.5, 0.5).

    The alpha of splat i at pixel p, with d = p - means2d[i] and (u, v, w) = sqrt_conics[i], is

        min(0.99, opacities[i] exp(-((u dx + v dy)^2 + (w dy)^2) / 2)),   0 where below 1/255.

    Attributes:
        means2d: x right, y down, pixels.
        sqrt_conics: triangular square root of the inverse covariance, 1 / pixels.
        depths: camera z, world units; nearest is drawn first, ties in their order here.
        extents: half width and height, pixels, of the box outside which alpha is 0. Zero means
            culled: drawn nowhere, with a zero gradient.
        colors: display-referred RGB, at least 0.
        opacities: alpha at the mean, in [0, 1].
        width, height: of the image, pixels (static).
        pull: None, or zeros to ask for a gradient that means2d cannot give: the sum over pixels of |dL/dx|
            and |dL/dy|, which is how hard pixels pull at the mean even where they pull in opposite
            directions. Its value changes nothing.
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
    """Returns the splats if their arrays fit together, and the channels to blend have a row for each.

    It looks at shapes and dtypes alone, so it works on traced arrays.

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
