"""Weights of the training photos in the loss: photos that do not fit the others get a lower weight."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatax.math.robust import MAD_TO_SIGMA
from splatax.training.objectives import PhotoWeights


@dataclass(frozen=True)
class EqualWeights:
    """Counts all photos alike."""

    def init(self, photos: int) -> tuple[()]:
        """Returns an empty state."""
        return ()

    def of_photos(self, state: tuple[()], photos: int, progress: Float[Array, ""]) -> Float[Array, " photos"]:
        """Returns ones."""
        return jnp.ones(photos)

    def of_photo(self, state: tuple[()], photo: Int[Array, ""] | np.int32, progress: Float[Array, ""]) -> Any:
        """Returns 1."""
        return 1.0

    def update(self, state: tuple[()], photo: Int[Array, ""] | np.int32, loss: Float[Array, ""]) -> tuple[()]:
        """Returns the state unchanged."""
        return state


class Losses(NamedTuple):
    """The losses of photos until now, as `RobustWeights` keeps them.

    The usual loss is a running mean over about one epoch. What counts for a photo is its loss as a multiple
    of the usual loss at that time, which compares photos that were seen at different times of a run.
    """

    ratios: Float[Array, " photos"]  # logarithm of the loss over the usual one, a mean of the latest visits
    seen: Bool[Array, " photos"]
    usual: Float[Array, ""]  # logarithm
    steps: Int[Array, ""]


@dataclass(frozen=True)
class RobustWeights:
    """Lowers the weights of photos whose loss stays far above that of the others.

    Such a photo has a wrong pose, belongs to another scene, or shows an object in front of the lens.
    The weight is (limit / ratio)^power, where the ratio is that of the photo's loss to the median photo's,
    and 1 up to the limit. The limit is `least`, or `spreads` robust standard deviations of the logarithm of
    all ratios if that is more. All photos count alike at first, while the scene still takes shape.
    """

    since: float = 1 / 3  # fraction of the run after which weights differ
    least: float = 2.5  # times the median loss; clean captures reach 1.2 to 2.5 there, see docs/capture.md
    spreads: float = 4.0
    floor: float = (
        0.1  # of the standard deviation of logarithms, so that nearly equal photos have no outliers
    )
    power: float = 4.0
    memory: float = 0.5  # weight of a photo's latest loss in its mean

    def init(self, photos: int) -> Losses:
        """Returns the state before the first step."""
        return Losses(jnp.zeros(photos), jnp.zeros(photos, bool), jnp.float32(0), jnp.int32(0))

    def of_photos(self, state: Losses, photos: int, progress: Float[Array, ""]) -> Float[Array, " photos"]:
        """Returns the weights of all photos; 1 for those that were not seen yet."""
        ratios = jnp.where(state.seen, state.ratios, jnp.nan)
        above = ratios - jnp.nanmedian(ratios)
        spread = jnp.maximum(MAD_TO_SIGMA * jnp.nanmedian(jnp.abs(above)), self.floor)
        excess = jnp.maximum(above - jnp.maximum(self.spreads * spread, math.log(self.least)), 0.0)
        judged = state.seen & (progress >= self.since)
        return jnp.where(judged, jnp.exp(-self.power * excess), 1.0)

    def of_photo(
        self, state: Losses, photo: Int[Array, ""] | np.int32, progress: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Returns the weight of one photo."""
        return self.of_photos(state, len(state.ratios), progress)[photo]

    def update(self, state: Losses, photo: Int[Array, ""] | np.int32, loss: Float[Array, ""]) -> Losses:
        """Returns the state after a step on one photo."""
        level, steps = jnp.log(jnp.maximum(loss, 1e-12)), state.steps + 1
        rate = 1.0 / jnp.minimum(steps, len(state.ratios)).astype(jnp.float32)
        usual = state.usual + rate * (level - state.usual)
        before = jnp.where(state.seen[photo], state.ratios[photo], level - usual)
        ratio = before + self.memory * (level - usual - before)
        return Losses(state.ratios.at[photo].set(ratio), state.seen.at[photo].set(True), usual, steps)


PHOTO_WEIGHTS: dict[str, PhotoWeights] = {"equal": EqualWeights(), "robust": RobustWeights()}
