"""Noise that is added to the scene at each training step: stochastic gradient Langevin dynamics."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.math import ellipsoids

SHARPNESS = 100  # slope of the gate, which lets noise through to faint Gaussians only
FAINT = 0.005  # opacity at which the gate is half open


@dataclass(frozen=True)
class NoNoise:
    """Adds no noise."""

    def __call__(
        self, gaussians: Gaussians, rate: Float[Array, " m"], extent: Float[Array, ""], key: PRNGKeyArray
    ) -> Gaussians:
        """Returns the scene unchanged."""
        return gaussians


@dataclass(frozen=True)
class Langevin:
    """Moves the centres of faint Gaussians at random, by their covariance (Kheradmand et al. 2024, Eq. 7).

    mean += strength * rate * Sigma (eps * sigmoid(-100 (opacity - 0.005))),   eps ~ N(0, I),

    with the learning rate of the means, and Sigma in units of the scene's extent, so that the result does
    not depend on the unit of length. Empty slots do not move.
    """

    strength: float = 5e5

    def __call__(
        self, gaussians: Gaussians, rate: Float[Array, " m"], extent: Float[Array, ""], key: PRNGKeyArray
    ) -> Gaussians:
        """Returns the scene with noise in its means.

        Args:
            gaussians: the scene.
            rate: learning rate of the means, world units per step: one, or one for each Gaussian.
            extent: of the scene, world units.
            key: of this step.
        """
        gate = jax.nn.sigmoid(-SHARPNESS * (gaussians.opacities - FAINT))
        gate = jnp.where(gaussians.opacity_logits > -jnp.inf, gate, 0)
        noise = jax.random.normal(key, gaussians.means.shape) * gate[:, None]
        shift = jax.vmap(_by_covariance)(gaussians.quats, gaussians.scales / extent, noise)
        return replace(gaussians, means=gaussians.means + self.strength * rate[:, None] * shift)


def _by_covariance(quat: Float[Array, "4"], scale: Float[Array, "3"], v: Float[Array, "3"]):
    """Returns Sigma v."""
    factor = ellipsoids.covariance_factor(quat, scale)
    return factor @ (factor.T @ v)
