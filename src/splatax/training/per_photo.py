"""Parameters of each training photo, learned by an Adam that keeps a state of its own for every photo."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from splatax.pytrees import pytree
from splatax.training.protocols import Source

ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-15)  # as for the Gaussians


Rows = TypeVar("Rows", bound="PerPhoto")


@pytree
@dataclass(frozen=True)
class PerPhoto:
    """A table of parameters, one row for each photo, and the state of the optimizer of each row.

    Attributes:
        values: the parameters, zero before the first step.
        opt_state: every array has one row for each photo, the step count among them.
    """

    values: Float[Array, "photos width"]
    opt_state: optax.ScaleByAdamState

    @property
    def visits(self) -> Int[Array, " photos"]:
        """Number of steps that each row has made."""
        return self.opt_state.count


class NoParameters:
    """Learns nothing of the photos: the base of null objects such as `NoAppearance`."""

    def init(self, photos: int) -> tuple[()]:
        """Returns an empty state."""
        return ()

    def for_photo(self, state: tuple[()], source: Source) -> tuple[()]:
        """Returns no parameters."""
        return ()

    def update(
        self, state: Any, source: Source, gradient: Any, progress: Float[Array, ""], steps: Float[Array, ""]
    ) -> Any:
        """Returns the state unchanged."""
        return state


class PerView:
    """Learns numbers of each photo, all zero at the start."""

    WIDTH: ClassVar[int]  # how many numbers a photo has

    def init(self, photos: int) -> PerPhoto:
        """Returns the table before the first step."""
        return zeros(photos, self.WIDTH)

    def for_photo(self, state: PerPhoto, source: Source) -> Float[Array, " width"]:
        """Returns the numbers of one photo."""
        return state.values[source.view]


def zeros(photos: int, width: int) -> PerPhoto:
    """Returns the table before the first step, with `width` parameters for each photo."""
    values = jnp.zeros((photos, width))
    return PerPhoto(values, jax.vmap(ADAM.init)(values))


def updated(
    table: Rows, index: Int[Array, ""] | np.int32, gradient: Float[Array, " width"], rate: Array
) -> Rows:
    """Makes one step of Adam in one row and leaves the other rows as they are.

    An Adam over the whole table would keep moving the rows of photos that the step does not show,
    because their moments are not zero. For the same reason each row counts its own steps.
    """
    row = jax.tree.map(lambda leaf: leaf[index], table.opt_state)
    direction, row = ADAM.update(gradient, row)
    return replace(
        table,
        values=table.values.at[index].add(-rate * direction),
        opt_state=jax.tree.map(lambda leaf, new: leaf.at[index].set(new), table.opt_state, row),
    )


def centred(values: Float[Array, "photos width"]) -> Float[Array, "photos width"]:
    """Subtracts the mean over photos from the parameters."""
    return values - jnp.mean(values, axis=0, keepdims=True)


def log_linear(first: float, last: float, progress: Float[Array, ""]) -> Float[Array, ""]:
    """Returns a learning rate that falls from `first` to `last`, log-linearly in the progress of the run."""
    return first * (last / first) ** progress
