"""No density control: the Gaussians of the initialization stay."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training.protocols import DensityPlan


@dataclass(frozen=True)
class NoDensityControl:
    """Never adds, moves or removes a Gaussian."""

    def init(self, capacity: int) -> tuple[()]:
        """Returns an empty state."""
        return ()

    def watch(self, splats: Splats) -> Splats:
        """Returns the splats unchanged."""
        return splats

    def observe(self, state: Any, splats: Splats, d_splats: Splats) -> Any:
        """Returns the state unchanged."""
        return state

    def due(self, step: int) -> bool:
        """Returns False."""
        return False

    def columns(self, state: Any, gaussians: Gaussians) -> tuple[()]:
        """Returns none."""
        return ()

    def plan(self, columns: Any, step: int, extent: float, key: PRNGKeyArray) -> DensityPlan:
        """Fails: it is never due."""
        raise AssertionError("never due")

    def reborn(self, gaussians: Gaussians, state: Any, given: Any) -> Gaussians:
        """Returns the Gaussians unchanged."""
        return gaussians
