"""Noise that is added to the scene at each training step: stochastic gradient Langevin dynamics."""

from dataclasses import dataclass

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.moving import shaken


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
    not depend on the unit of length. Empty slots do not move; see `splatax.moving.shaken`.
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
        drawn = jax.random.normal(key, gaussians.means.shape)
        return shaken(gaussians, self.strength, rate, extent, drawn)
