"""Backgrounds that depend on the direction of view: what lies behind an open scene."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.math import harmonics
from splatax.pytrees import pytree


@runtime_checkable
class Surroundings(Protocol):
    """Colour in every direction. A pytree, whose numbers have gradients."""

    def __call__(self, directions: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """Returns the RGB that is seen in each direction, a unit vector in the world."""
        ...


@pytree
@dataclass(frozen=True)
class Sky:
    """Smooth surroundings by spherical harmonics, in the convention of `Gaussians.sh`.

    Attributes:
        sh: coefficients; 1, 4, 9, 16 or 25 of them for degrees 0 to 4.
    """

    sh: Float[Array, "k 3"]

    def __call__(self, directions: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """Returns the RGB of each direction, at least 0."""
        evaluate = jax.vmap(jax.vmap(lambda direction: harmonics.evaluate(self.sh, direction)))
        return jnp.maximum(evaluate(directions) + 0.5, 0)
