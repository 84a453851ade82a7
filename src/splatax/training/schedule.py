"""The place in a recipe's schedule of a step of a run whose number of steps changes while it is made."""

from dataclasses import dataclass

from splatax.training.protocols import DensityStrategy, ResolutionSchedule


@dataclass(eq=False)
class Schedule:
    """Maps steps of a run to the steps of its recipe at the same fraction. Without changes they are equal.

    It is a resolution schedule itself.

    Attributes:
        planned: steps of the recipe.
        total: steps of the run, as planned now.
        resolution: size of photos over the steps of the recipe.
    """

    planned: int
    total: int
    resolution: ResolutionSchedule

    def place(self, step: int) -> int:
        """Returns the step of the recipe that a step of the run stands for, rounded up."""
        return -(-step * self.planned // self.total)

    def refinement(self, step: int, density: DensityStrategy) -> int:
        """Returns the step of the recipe whose refinement is due after a step of the run; 0 for none."""
        stands_for = range(self.place(step), self.place(step - 1), -1)
        return next((place for place in stands_for if density.due(place)), 0)

    @property
    def divisors(self) -> tuple[int, ...]:
        """All factors by which photos are downscaled during a run."""
        return self.resolution.divisors

    def divisor(self, step: int, size: tuple[int, int]) -> int:
        """Returns the factor by which photos of a size are downscaled at a step of the run."""
        return self.resolution.divisor(self.place(step), size)
