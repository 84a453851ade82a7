"""What the trainer asks of a density strategy, and what it gets back."""

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.splats import Splats


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lineage:
    """Where the rows of a refined scene come from: all that the optimizer needs to follow.

    Attributes:
        parent: for each new row, the old one whose Adam moments it inherits.
        newborn: rows that start from zero moments instead; empty slots are among them.
        restarted: fields whose moments start from zero in every row (static).
    """

    parent: Int[Array, " n"]
    newborn: Bool[Array, " n"]
    restarted: tuple[str, ...] = field(default=(), metadata={"static": True})


@dataclass(frozen=True)
class DensityUpdate:
    """A refined scene: the living Gaussians first, then empty slots."""

    gaussians: Gaussians
    count: int  # of living Gaussians
    lineage: Lineage
    state: Any  # of the strategy, for the new rows


@runtime_checkable
class DensityStrategy(Protocol):
    """Frozen and hashable: it holds settings; what it has seen is in its state, a pytree."""

    def init(self, capacity: int) -> Any:
        """The state before any step, for so many rows."""
        ...

    def watch(self, splats: Splats) -> Splats:
        """The splats of a view, with `pull` if `observe` wants its gradient."""
        ...

    def observe(self, state: Any, splats: Splats, d_splats: Splats) -> Any:
        """Takes note of one view: its splats and the gradient of the loss in them. Runs under `jit`."""
        ...

    def due(self, step: int) -> bool:
        """Whether to refine after this many steps."""
        ...

    def refine(
        self, state: Any, gaussians: Gaussians, count: int, step: int, extent: float, key: PRNGKeyArray
    ) -> DensityUpdate:
        """Adds and removes Gaussians. The same arguments give the same scene.

        Args:
            state: what was observed since the last time.
            gaussians: rows from `count` on are empty slots.
            count: of living Gaussians.
            step: how many have been made.
            extent: of the scene, world units.
            key: for whatever is random.
        """
        ...
