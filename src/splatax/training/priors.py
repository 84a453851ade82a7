"""Penalties on the scene that training adds to the loss of the photos."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatax.gaussians import Gaussians
from splatax.training.protocols import Prior

LONG = 8_000  # a run that looks at so many photos over-fits with the smaller weight; see docs/recipes.md


@dataclass(frozen=True)
class NoPrior:
    """Adds no penalty."""

    def __call__(
        self, gaussians: Gaussians, extent: Float[Array, ""], living: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Returns zero."""
        return jnp.zeros(())


@dataclass(frozen=True)
class Sparsity:
    """Penalizes opacity and size, so that unnecessary Gaussians fade (Kheradmand et al. 2024, Eq. 8)."""

    opacity: float = 0.01  # weight of the mean opacity
    scale: float = 0.01  # weight of the mean standard deviation along an axis, in extents of the scene

    def __call__(
        self, gaussians: Gaussians, extent: Float[Array, ""], living: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Returns the penalty. Means are over the living Gaussians; empty slots get no gradient."""
        lives = gaussians.opacity_logits > -jnp.inf
        count = jnp.maximum(living, 1)
        opacity = jnp.sum(jnp.where(lives, gaussians.opacities, 0)) / count
        scale = jnp.sum(jnp.where(lives[:, None], gaussians.scales, 0)) / (3 * count)
        return self.opacity * opacity + self.scale * scale / extent


@dataclass(frozen=True)
class Flatness:
    """Penalizes the thickness of Gaussians, so that each is a piece of a surface (Chen et al. 2024, PGSR)."""

    thickness: float = 1.0  # weight of the mean of the least standard deviation, in extents of the scene

    def __call__(
        self, gaussians: Gaussians, extent: Float[Array, ""], living: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Returns the penalty. The mean is over the living Gaussians; empty slots get no gradient."""
        lives = gaussians.opacity_logits > -jnp.inf
        least = jnp.min(gaussians.scales, axis=1)
        return self.thickness * jnp.sum(jnp.where(lives, least, 0)) / jnp.maximum(living, 1) / extent


@dataclass(frozen=True)
class Priors:
    """The sum of several priors."""

    parts: tuple[Prior, ...]

    def __call__(
        self, gaussians: Gaussians, extent: Float[Array, ""], living: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Returns the sum of the penalties."""
        return sum((part(gaussians, extent, living) for part in self.parts), start=jnp.zeros(()))


def opacity_penalty(photos: int) -> float:
    """Returns the weight of the mean opacity in the prior of `default`.

    The smaller weight keeps surfaces solid, but long runs over-fit with it. There are only two weights, so
    that runs of different lengths share compiled programs.

    Args:
        photos: number of photos that the run looks at, with repetitions.
    """
    return 0.003 if photos < LONG else 0.01
