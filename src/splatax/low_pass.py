"""Filters that widen the splats of a view, so that none falls between its pixels.

A scene is drawn with the filter that it was trained with: its shapes and opacities have grown used to it.
"""

from dataclasses import dataclass

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


LowPass = Dilation | Antialiasing
LOW_PASSES: dict[str, LowPass] = {"dilation": Dilation(), "antialiasing": Antialiasing()}
