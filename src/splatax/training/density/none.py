"""No density control: the Gaussians of the start stay."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training.protocols import DensityUpdate


@dataclass(frozen=True)
class NoDensityControl:
    """Leaves the number of Gaussians as it is."""

    def init(self, capacity: int) -> tuple[()]:
        return ()

    def watch(self, splats: Splats) -> Splats:
        return splats

    def observe(self, state: Any, splats: Splats, d_splats: Splats) -> Any:
        return state

    def due(self, step: int) -> bool:
        return False

    def refine(
        self, state: Any, gaussians: Gaussians, count: int, step: int, extent: float, key: PRNGKeyArray
    ) -> DensityUpdate:
        raise AssertionError("never due")
