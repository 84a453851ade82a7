"""Growth of the number of Gaussians from one refinement to the next."""

from dataclasses import dataclass
from numbers import Integral


@dataclass(frozen=True)
class ByFactor:
    """Multiplies the number of Gaussians by `factor` at each refinement (Kheradmand et al. 2024)."""

    factor: float = 1.05

    def after(self, count: int, step: int, every: int, max_gaussians: int) -> int:
        """Returns the number of Gaussians after a refinement."""
        return min(int(self.factor * count), max_gaussians)


@dataclass(frozen=True)
class ByStep:
    """Multiplies the number of Gaussians by equal factors, so that it reaches the maximum at step `full`."""

    full: int  # step at which the maximum is reached

    def after(self, count: int, step: int, every: int, max_gaussians: int) -> int:
        """Returns the number of Gaussians after a refinement."""
        refinements = max((self.full - step) // every, 0) + 1  # left, including this one
        return round(count * (max_gaussians / count) ** (1 / refinements))


Growth = ByFactor | ByStep


def require_limit(max_gaussians: int) -> None:
    """Checks the largest number of Gaussians.

    Raises:
        ValueError: if it is not a whole number of at least 1.
    """
    if not isinstance(max_gaussians, Integral) or max_gaussians < 1:
        raise ValueError(f"max_gaussians must be a whole number of at least 1, not {max_gaussians}")
