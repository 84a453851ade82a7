"""A row of numbers for each photo, learned by an Adam of its own: what a photo alone can tell."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatax.training.feed import Source

FIRST, SECOND, EPSILON = 0.9, 0.999, 1e-15  # of Adam, as for Gaussians


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PerPhoto:
    """A table, and what Adam remembers of each row.

    Attributes:
        values: zero at the start.
        mean: of the gradients of a row, decaying.
        square: of their squares.
        visits: how often a row was moved.
    """

    values: Float[Array, "photos width"]
    mean: Float[Array, "photos width"]
    square: Float[Array, "photos width"]
    visits: Int[Array, " photos"]


class NoParameters:
    """In place of what has a table: nothing is learned of a photo, and nothing is known."""

    def init(self, photos: int) -> tuple[()]:
        """The state before any step."""
        return ()

    def of(self, state: tuple[()], source: Source) -> tuple[()]:
        """What is known of a photo."""
        return ()

    def update(self, state: tuple[()], *step: object) -> tuple[()]:
        """The state after a step."""
        return state


def zeros(photos: int, width: int) -> PerPhoto:
    """Before any step."""
    values, mean, square = (jnp.zeros((photos, width)) for _ in range(3))
    return PerPhoto(values, mean, square, jnp.zeros(photos, jnp.int32))


def moved(
    rows: PerPhoto, index: Int[Array, ""] | np.int32, gradient: Float[Array, " width"], rate: Array
) -> PerPhoto:
    """One step of Adam for one row; the others keep still.

    An Adam over the whole table would go on moving the rows of photos that are not looked at, by what
    it remembers of them.
    """
    visits = rows.visits[index] + 1
    mean = FIRST * rows.mean[index] + (1 - FIRST) * gradient
    square = SECOND * rows.square[index] + (1 - SECOND) * gradient * gradient
    count = visits.astype(mean.dtype)
    step = mean / (1 - FIRST**count) / (jnp.sqrt(square / (1 - SECOND**count)) + EPSILON)
    return PerPhoto(
        rows.values.at[index].add(-rate * step),
        rows.mean.at[index].set(mean),
        rows.square.at[index].set(square),
        rows.visits.at[index].set(visits),
    )


def centred(values: Float[Array, "photos width"]) -> Float[Array, "photos width"]:
    """The same, but for what all rows have in common: their mean is zero."""
    return values - jnp.mean(values, axis=0, keepdims=True)


def falling(first: float, last: float, progress: Float[Array, ""]) -> Float[Array, ""]:
    """A rate that goes from one value to another, log-linearly in the share of the run that is done."""
    return first * (last / first) ** progress
