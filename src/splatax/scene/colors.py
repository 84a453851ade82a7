"""Affine maps of colour, applied to spherical harmonics without approximation."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.pytrees import pytree

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB (ITU-R BT.709)


@pytree
@dataclass(frozen=True)
class ColorMap:
    """An affine map of display-referred colour, c' = M c + b, in every direction of view.

    Colours are sums of harmonics, so the map of the coefficients is exact. A colour below zero is drawn as
    zero after the map, not before it.

    Attributes:
        matrix: M, from RGB to RGB.
        offset: b, RGB.
    """

    matrix: Float[np.ndarray, "3 3"] | Float[Array, "3 3"]
    offset: Float[np.ndarray, "3"] | Float[Array, "3"]

    @classmethod
    def tint(cls, color: tuple[float, float, float]) -> "ColorMap":
        """Returns the map that multiplies red, green and blue by the three numbers."""
        return cls(np.diag(np.asarray(color, np.float32)), np.zeros(3, np.float32))

    @classmethod
    def dye(cls, color: tuple[float, float, float]) -> "ColorMap":
        """Returns the map that replaces hue: it multiplies `color` by the luminance of each colour."""
        return cls(np.outer(np.asarray(color, np.float32), LUMINANCE), np.zeros(3, np.float32))

    def transform(self, gaussians: Gaussians) -> Gaussians:
        """Returns Gaussians whose colours are mapped; broken rows stay broken, without a gradient."""
        sh = gaussians.sh
        matrix, offset = jnp.asarray(self.matrix, sh.dtype), jnp.asarray(self.offset, sh.dtype)
        finite = jnp.isfinite(sh)
        known = jnp.where(finite, sh, 0)
        with jax.default_matmul_precision("highest"):
            mapped = known @ matrix.T
            gray = jnp.full(3, 0.5, sh.dtype)  # harmonics add to this colour
            constant = (matrix @ gray + offset - gray) / harmonics.Y00
        mapped = mapped.at[:, 0].add(constant[None])
        whole = jnp.all(finite, axis=(1, 2), keepdims=True)
        return replace(gaussians, sh=jnp.where(whole, mapped, sh))
