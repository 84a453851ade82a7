"""Penalties on the scene that training adds to the loss of the photos."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.gaussians import Gaussians


@dataclass(frozen=True)
class NoPrior:
    """Adds no penalty."""

    def __call__(self, gaussians: Gaussians, extent: Float[Array, ""]) -> Float[Array, ""]:
        """Returns zero."""
        return jnp.zeros(())


@dataclass(frozen=True)
class Sparsity:
    """Penalizes opacity and size, so that unnecessary Gaussians fade (Kheradmand et al. 2024, Eq. 8)."""

    opacity: float = 0.01  # weight of the mean opacity
    scale: float = 0.01  # weight of the mean standard deviation along an axis, in extents of the scene

    def __call__(self, gaussians: Gaussians, extent: Float[Array, ""]) -> Float[Array, ""]:
        """Returns the penalty. Means are over the living Gaussians; empty slots get no gradient."""
        living = gaussians.opacity_logits > -jnp.inf
        count = jnp.maximum(jnp.sum(living), 1)
        opacity = jnp.sum(jnp.where(living, gaussians.opacities, 0)) / count
        scale = jnp.sum(jnp.where(living[:, None], gaussians.scales, 0)) / (3 * count)
        return self.opacity * opacity + self.scale * scale / extent
