"""What is behind the scene while it trains."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from splatax.training.protocols import Background


@dataclass(frozen=True)
class Solid:
    """One colour. Photos with alpha are composited over it."""

    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def sample(self, key: PRNGKeyArray) -> Float[Array, "3"]:
        """The background of a step."""
        return jnp.array(self.rgb)


@dataclass(frozen=True)
class Random:
    """Another colour at each step, so that no Gaussian can pass for background: against haze."""

    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where evaluation needs one

    def sample(self, key: PRNGKeyArray) -> Float[Array, "3"]:
        """The background of a step."""
        return jax.random.uniform(key, (3,))


BACKGROUNDS: dict[str, Background] = {"black": Solid(), "white": Solid((1.0, 1.0, 1.0)), "random": Random()}
