"""What training prefers whatever the photos show."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.gaussians import Gaussians


@dataclass(frozen=True)
class NoPrior:
    """The photos decide alone."""

    def __call__(self, gaussians: Gaussians, extent: Float[Array, ""]) -> Float[Array, ""]:
        """Nothing."""
        return jnp.zeros(())


@dataclass(frozen=True)
class Sparsity:
    """Few and small: what the photos do not need fades, and dies (Kheradmand et al. 2024, Eq. 8)."""

    opacity: float = 0.01  # times the mean opacity
    scale: float = 0.01  # times the mean standard deviation along an axis, in extents of the scene

    def __call__(self, gaussians: Gaussians, extent: Float[Array, ""]) -> Float[Array, ""]:
        """What is added to the loss. Means are over the living; empty slots have no gradient."""
        living = gaussians.opacity_logits > -jnp.inf
        count = jnp.maximum(jnp.sum(living), 1)
        opacity = jnp.sum(jnp.where(living, gaussians.opacities, 0)) / count
        scale = jnp.sum(jnp.where(living[:, None], gaussians.scales, 0)) / (3 * count)
        return self.opacity * opacity + self.scale * scale / extent
