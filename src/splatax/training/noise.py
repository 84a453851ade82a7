"""Noise in the steps of training, so that it explores: stochastic gradient Langevin dynamics."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.math import ellipsoids

SHARPNESS = 100  # of the gate, which lets through the noise of faint Gaussians alone
FAINT = 0.005  # opacity at which it is half open


@dataclass(frozen=True)
class NoNoise:
    """No noise."""

    def __call__(
        self, gaussians: Gaussians, rate: Float[Array, ""], extent: Float[Array, ""], key: PRNGKeyArray
    ) -> Gaussians:
        """The scene as it is."""
        return gaussians


@dataclass(frozen=True)
class Langevin:
    """Shakes the centres of faint Gaussians along their own shape (Kheradmand et al. 2024, Eq. 7).

    mean += strength * rate * Sigma (eps * sigmoid(-100 (opacity - 0.005))),   eps ~ N(0, I),

    with the learning rate of means and Sigma in units of the scene's extent, so that the size of the
    world changes nothing. Empty slots stay where they are.
    """

    strength: float = 5e5

    def __call__(
        self, gaussians: Gaussians, rate: Float[Array, ""], extent: Float[Array, ""], key: PRNGKeyArray
    ) -> Gaussians:
        """The scene after the shake.

        Args:
            gaussians: the scene.
            rate: of means, world units a step.
            extent: of the scene, world units.
            key: of this step.
        """
        gate = jax.nn.sigmoid(-SHARPNESS * (gaussians.opacities - FAINT))
        gate = jnp.where(gaussians.opacity_logits > -jnp.inf, gate, 0)
        noise = jax.random.normal(key, gaussians.means.shape) * gate[:, None]
        shift = jax.vmap(_by_covariance)(gaussians.quats, gaussians.scales / extent, noise)
        return replace(gaussians, means=gaussians.means + self.strength * rate * shift)


def _by_covariance(quat: Float[Array, "4"], scale: Float[Array, "3"], v: Float[Array, "3"]):
    """Sigma v."""
    factor = ellipsoids.covariance_factor(quat, scale)
    return factor @ (factor.T @ v)
