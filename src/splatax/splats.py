"""The seam of the pipeline: `Splats`, the 2D Gaussians of one view.

Left of it (projection) is JAX that every device shares; right of it is all that a rasterizer
backend implements. The cotangent that crosses it is the signal that density control reads.
"""

from dataclasses import dataclass, field

import jax
from jaxtyping import Array, Float

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
            culled: drawn nowhere, with no gradient.
        colors: display-referred RGB, at least 0.
        opacities: alpha at the mean, in [0, 1].
        width, height: of the image, pixels (static).
        pull: None, or zeros, to ask for a gradient that means2d cannot give: the sum over pixels of
            |dL/dx| and |dL/dy|, how hard pixels pull at the mean, be it in opposite directions. It
            moves nothing.
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
