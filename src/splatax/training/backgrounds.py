"""Backgrounds: the colour behind the scene, and behind photos with alpha, during training."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from splatax.training.protocols import Background


@dataclass(frozen=True)
class Solid:
    """The same colour at every step."""

    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def sample(self, key: PRNGKeyArray) -> Float[Array, "3"]:
        """Returns the colour."""
        return jnp.array(self.rgb)


@dataclass(frozen=True)
class Random:
    """A new colour at every step, which prevents haze: no Gaussian can imitate the background."""

    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)  # for evaluation and pictures

    def sample(self, key: PRNGKeyArray) -> Float[Array, "3"]:
        """Returns a uniformly distributed colour."""
        return jax.random.uniform(key, (3,))


BACKGROUNDS: dict[str, Background] = {"black": Solid(), "white": Solid((1.0, 1.0, 1.0)), "random": Random()}
