"""Corrects the number of steps of a run by the clock, so that the run ends in a given time.

The corrections are recorded as `Changes`, so that the run can be repeated without a clock.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from splatax.runs.budget import FEWEST_STEPS, UNLIMITED, Costs
from splatax.training.recipes import COARSE

RECENT = 5  # measurements whose median is the speed, so that compilation does not count as a lasting slowdown
STRIDE, STEADY = (
    1.25,
    0.7,
)  # most that one look changes the number of steps by, up to this fraction of the run


@dataclass
class Changes:
    """Changes of a run's number of steps, as `optimize` takes them for its pace.

    Attributes:
        made: (step after which, new total), in order; it grows.
    """

    made: list[tuple[int, int]] = field(default_factory=list)

    def __call__(self, step: int) -> int | None:
        """Returns the total that holds from this step on; None if it does not change there."""
        return dict(self.made).get(step)

    def due(self, step: int, total: int) -> bool:
        """Returns whether to call `note` after a step."""
        return False

    def note(self, step: int, total: int, seconds: float) -> None:
        """Changes the number of steps by the time, if that is needed."""


@dataclass(frozen=True)
class Expected:
    """Cost of a run's steps as it was planned.

    Attributes:
        costs: of steps on this machine.
        first: Gaussians at the start.
        most: Gaussians that the run grows to.
    """

    costs: Costs
    first: int
    most: int

    def seconds_left(self, step: int, total: int) -> float:
        """Returns the seconds for the rest of a run of `total` steps, after `step` of them."""
        return total * self.costs.rest(min(step / total, 1.0), self.first, self.most)


@dataclass
class Clock(Changes):
    """Changes the number of steps so that a run ends in time.

    The schedules of a run follow its number of steps: growth, half-size photos and the decay of the learning
    rates take the same fractions of the steps that there is time for.

    Attributes:
        seconds: for the whole run.
        checked: step and seconds of the last call of `note`.
        expected: planned cost of the steps. None, as for a resumed run, assumes that all steps
            take as long as the latest.
        slowness: measured time of steps over the planned time, for each look at the clock.
        left: returns the seconds left for training, where the whole command is limited; else None.
        longest: upper limit of the number of steps.
    """

    seconds: float = 0.0
    checked: tuple[int, float] = (0, 0.0)
    expected: Expected | None = None
    slowness: list[float] = field(default_factory=list)
    left: Callable[[], float] | None = None
    longest: int = UNLIMITED

    def due(self, step: int, total: int) -> bool:
        """Returns true every 5 percent of the run; if it was not planned, after its first fifth."""
        first = total / 5 if self.expected is None else 1
        return first <= step < total and step % max(round(total / 20), 1) == 0

    def note(self, step: int, total: int, seconds: float) -> None:
        """Plans the rest of the run by its speed until now.

        Without a plan, a run that grows or whose photos get larger is only shortened, if it would be late
        even as fast as now: its steps get slower.
        """
        (before, then), self.checked = self.checked, (step, seconds)
        if self.expected is None:
            a_step = (seconds - then) / (step - before)
            planned = max(step + max(round((self.seconds - seconds) / a_step), 1), FEWEST_STEPS)
            planned = max(min(planned, self.longest), step + 1)
            if planned < total or (planned > total and before > total / COARSE):
                self.made.append((step, planned))
            return
        if before == 0:  # this part has compiled the first program
            return
        modelled = self.expected.seconds_left(before, total) - self.expected.seconds_left(step, total)
        self.slowness.append((seconds - then) / max(modelled, 1e-9))
        slowness = float(np.median(self.slowness[-RECENT:]))
        left = self.left() if self.left else self.seconds - seconds
        planned = self._affordable(step, left, slowness)
        if step < STEADY * total:
            planned = round(np.clip(planned, total / STRIDE, total * STRIDE))
        planned = max(min(planned, self.longest), FEWEST_STEPS, step + 1)
        if planned != total:
            self.made.append((step, planned))

    def _affordable(self, step: int, left: float, slowness: float) -> int:
        """Returns the most steps for which the rest of the run takes no longer than the time left."""
        assert self.expected
        low, high = step, max(self.longest, step)
        while low < high:
            middle = (low + high + 1) // 2
            if slowness * self.expected.seconds_left(step, middle) <= left:
                low = middle
            else:
                high = middle - 1
        return low
