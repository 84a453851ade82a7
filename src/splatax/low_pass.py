"""Filters that widen the splats of a view, so that none falls between its pixels.

A scene is drawn with the filter that it was trained with, because its shapes and opacities were
optimized with it.
"""

import math
from dataclasses import dataclass, replace

import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Dilation:
    """Low-pass filter that adds variance and keeps the opacity (authors' code of Kerbl et al. 2023)."""

    variance: float = 0.3  # pixels^2

    def fade(self, sharp: Float[Array, ""], blurred: Float[Array, ""]) -> Float[Array, ""]:
        """Returns the factor on opacity, from the determinants before and after the variance is added: 1."""
        return jnp.ones_like(sharp)


@dataclass(frozen=True)
class Antialiasing:
    """Low-pass filter that adds variance and keeps the total light, so that distant splats do not thicken.

    The 2D Mip filter of Yu et al. 2024, Eq. 9: opacity times sqrt(|Sigma| / |Sigma + v I|).
    """

    variance: float = 0.3  # pixels^2
    floor: float = 0.005  # lower bound of the factor, so that its gradient stays finite for flat Gaussians

    def fade(self, sharp: Float[Array, ""], blurred: Float[Array, ""]) -> Float[Array, ""]:
        """Returns the factor on opacity, from the determinants before and after the variance is added."""
        return jnp.sqrt(jnp.maximum(sharp / blurred, self.floor**2))


@dataclass(frozen=True)
class AlongRays:
    """Draws Gaussians by their largest density along the ray of each pixel, and none smaller than a blur.

    The other filters draw the tangent image of a Gaussian, an ellipse that is widened. This one is exact in
    perspective: at a pixel, the Gaussian has the larger of its best response along the ray and of a 2D
    Gaussian of this variance around the image of its mean. A flat Gaussian is a disc, and its best response
    that of the point where the ray meets it (Huang et al. 2024, Eq. 11). See `splatax.along_rays`.
    """

    variance: float = 0.5  # pixels^2

    def fade(self, sharp: Float[Array, ""], blurred: Float[Array, ""]) -> Float[Array, ""]:
        """Returns the factor on opacity, from the determinants before and after the variance is added: 1."""
        return jnp.ones_like(sharp)


LowPass = Dilation | Antialiasing | AlongRays
LOW_PASSES: dict[str, LowPass] = {
    "dilation": Dilation(),
    "antialiasing": Antialiasing(),
    "along-rays": AlongRays(),
}


def low_pass_of(text: str) -> LowPass:
    """Returns the filter of a text: its name, or name and variance in square pixels ("antialiasing:0.1").

    Raises:
        ValueError: if there is no such filter, or the variance is not above 0.
    """
    name, separator, number = text.partition(":")
    if name not in LOW_PASSES:
        raise ValueError(f"no filter {name!r}. There are {', '.join(LOW_PASSES)}")
    if not separator:
        return LOW_PASSES[name]
    try:
        variance = float(number)
    except ValueError:
        variance = math.nan
    if not 0 < variance < math.inf:
        raise ValueError(f"{number!r} is no variance in square pixels above 0")
    return replace(LOW_PASSES[name], variance=variance)
