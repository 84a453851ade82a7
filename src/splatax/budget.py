"""As much training as fits into a given time: the number of steps and of Gaussians, from measured speed.

Before the run, the cost of a step on this machine is measured on procedural scenes, which have the
statistics of trained ones. While it goes on, the number of steps is corrected by the clock. What came
of it is kept as `Changes`, and repeats without a clock.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from splatax.bench.operations import step as operation
from splatax.bench.scenes import procedural
from splatax.bench.timing import timed
from splatax.training.capacity import GROWTH
from splatax.training.recipes import COARSE, GROWING, Recipe

PROBES = (20_000, 80_000)  # Gaussians; steps are linear in them
ROUNDS = 5
GAUSSIANS_PER_STEP = 60  # of a run; see docs/results.md
HEAVIER = 1.45  # a step of a capture than one of a procedural scene: 1.6 measured on fern, 1.4 on fox
COMPILING = 0.7  # seconds for each size of the arrays that a scene grows through
FEWEST_STEPS = 200  # with fewer there is hardly a picture, so a run takes longer than asked rather
ROUND = 1_000  # Gaussians: plans that differ little share compiled programs
UNITS = {"s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def quantity(text: str, units: Mapping[str, float], wanted: str) -> float:
    """A number with a unit, in terms of 1.

    Args:
        text: of the user, in any case.
        units: by name, in lower case.
        wanted: what it should be, for the message.

    Raises:
        ValueError: if it is something else, or not positive.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([a-z]*)\s*", text.lower())
    if not match or match[2] not in units or not float(match[1]):
        raise ValueError(f"{wanted}, not {text!r}")
    return float(match[1]) * units[match[2]]


def parse_seconds(text: str) -> float:
    """Seconds from "90s", "5min" or "1.5h".

    Raises:
        ValueError: if it is something else, or not positive.
    """
    return quantity(text, UNITS, "a time such as 90s, 5min or 1.5h")


def mean_count(first: int, most: int) -> float:
    """Of the Gaussians in the coarse part of a run of the recipe `default`: they grow by equal factors, and
    then there are as many as in the rest of the run."""
    growing = (most - first) / np.log(most / first) if most > first else most
    return float(growing * COARSE + most * (GROWING - COARSE)) / GROWING


@dataclass(frozen=True)
class Cost:
    """Seconds that a step takes: so many, and so many for each Gaussian."""

    base: float
    each: float

    def step(self, count: int | float) -> float:
        return self.base + self.each * count


@dataclass(frozen=True)
class Costs:
    """Of steps with photos of half size, and as they are."""

    coarse: Cost
    fine: Cost

    def run(self, steps: int, first: int, most: int) -> float:
        """Seconds for a run of the recipe `default` that grows to `most`."""
        programs = np.log(max(most / first, 1)) / np.log(GROWTH) + 2
        coarse, fine = self.coarse.step(mean_count(first, most)), self.fine.step(most)
        return float(steps * (coarse + (COARSE - 1) * fine) / COARSE + COMPILING * programs)


def measured(size: tuple[int, int], recipe: Recipe) -> Costs:
    """Times steps of procedural scenes, a few seconds in all.

    Args:
        size: of the photos, width and height in pixels.
        recipe: with the backend that is to run.
    """
    fine, smaller = cost_of(size, recipe), coarse_size(size, recipe)
    return Costs(fine if smaller == size else cost_of(smaller, recipe), fine)


def coarse_size(size: tuple[int, int], recipe: Recipe) -> tuple[int, int]:
    """Of photos in the first steps of a recipe."""
    divisor = recipe.resolution.divisor(1, size)
    return size[0] // divisor, size[1] // divisor


def cost_of(size: tuple[int, int], recipe: Recipe) -> Cost:
    """Of a step with photos of a size, from two procedural scenes."""
    seconds = []
    for count in PROBES:
        work = operation(procedural(count, size), recipe)
        timed(work)  # compiles
        seconds.append(min(timed(work) for _ in range(ROUNDS)) / 1e3)
    each = max((seconds[1] - seconds[0]) / (PROBES[1] - PROBES[0]), 0.0)
    return Cost(HEAVIER * max(seconds[0] - each * PROBES[0], 1e-4), HEAVIER * each)


@dataclass(frozen=True)
class Plan:
    """What fits."""

    steps: int
    max_gaussians: int


def plan(costs: Costs, seconds: int | float, first: int, room: int, most: int | None = None) -> Plan:
    """The number of steps for the time, with as many Gaussians as they can teach, or as are given.

    Args:
        costs: of a step.
        seconds: for the whole run.
        first: Gaussians at the start.
        room: how many there may be.
        most: how many there shall be, if that is given.
    """

    def gaussians(steps: int) -> int:
        taught = GAUSSIANS_PER_STEP * steps // ROUND * ROUND
        return most or int(np.clip(taught, min(first, room), room))

    low, high = FEWEST_STEPS, 10_000_000
    while low < high:  # the most steps that fit
        middle = (low + high + 1) // 2
        if costs.run(middle, min(first, gaussians(middle)), gaussians(middle)) <= seconds:
            low = middle
        else:
            high = middle - 1
    return Plan(low, gaussians(low))


@dataclass
class Changes:
    """New totals of steps, each from a step on: the pace of a run, as it is given to `optimize`.

    Attributes:
        made: (step after which, new total), in order; it grows.
    """

    made: list[tuple[int, int]] = field(default_factory=list)

    def __call__(self, step: int) -> int | None:
        """The total that holds from this step on, if it changes there."""
        return dict(self.made).get(step)

    def due(self, step: int, total: int) -> bool:
        """Whether the clock is wanted after a step."""
        return False

    def note(self, step: int, total: int, seconds: float) -> None:
        """Takes note of the time."""


@dataclass
class Clock(Changes):
    """Makes changes so that a run ends in time.

    Attributes:
        seconds: for the whole run.
        checked: the step and the time of the last look.
    """

    seconds: float = 0.0
    checked: tuple[int, float] = (0, 0.0)

    def due(self, step: int, total: int) -> bool:
        """Every 5 percent, once the first programs are compiled."""
        return total / 5 <= step < total and step % max(round(total / 20), 1) == 0

    def note(self, step: int, total: int, seconds: float) -> None:
        """Plans the rest of the run by the speed since the last look.

        While the scene grows, and when photos get larger, steps get slower, so until then a run is only
        shortened, if it would be late even as fast as now.
        """
        (before, then), self.checked = self.checked, (step, seconds)
        a_step = (seconds - then) / (step - before)
        planned = max(step + max(round((self.seconds - seconds) / a_step), 1), FEWEST_STEPS)
        if planned < total or (planned > total and before > total / COARSE):
            self.made.append((step, planned))
