"""Plans the number of steps and of Gaussians for a given training time, from measured speed.

Before the run, the cost of a step on this machine is measured on procedural scenes, which have the
statistics of trained ones. During the run, `splatax.runs.clock` corrects the number of steps.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from splatax import backends
from splatax.bench.operations import step as operation
from splatax.bench.scenes import procedural
from splatax.bench.timing import timed
from splatax.cameras.lenses import Lens, Pinhole
from splatax.training.capacity import GROWTH
from splatax.training.recipes import COARSE, GROWING, MOST, Recipe

DEFAULT_BUDGET = "6min"  # of training, where neither a time nor a number of steps is given
PROBES = (20_000, 80_000)  # Gaussians; steps are linear in them
ROUNDS = 5
GAUSSIANS_PER_STEP = 60  # of a run, up to one for 8 pixels; see docs/results.md
DENSER_PER_STEP = 6  # of a long run, beyond one for 8 pixels; see docs/recipes.md
DENSEST = 2  # limit of a long run, as a multiple of one for 8 pixels
HEAVIER = 1.45  # a step of a capture than one of a procedural scene: 1.6 measured on fern, 1.4 on fox
COMPILING = 0.7  # seconds for each size of the arrays that a scene grows through
FEWEST_STEPS = 200  # with fewer, scenes are unusable, so a run may exceed its budget
MOST_VISITS = 500  # steps for each training view: more over-fit; see docs/recipes.md
UNLIMITED = 10_000_000  # steps
PARTS = 400  # of a run, over which the cost of its steps is summed
ROUND = 1_000  # Gaussians: plans that differ little share compiled programs
SIZES = {"": 1.0, "b": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9, "mib": 2.0**20, "gib": 2.0**30}
UNITS = {"s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def quantity(text: str, units: Mapping[str, float], wanted: str) -> float:
    """Returns a number with a unit as a multiple of the base unit.

    Args:
        text: from the user, in upper or lower case.
        units: size of each in base units, by name in lower case.
        wanted: description of a valid text, for the message.

    Raises:
        ValueError: if it is something else, or not positive.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([a-z]*)\s*", text.lower())
    if not match or match[2] not in units or not float(match[1]):
        raise ValueError(f"{wanted}, not {text!r}")
    return float(match[1]) * units[match[2]]


def duration(seconds: float) -> str:
    """Returns a time in words: "45 s", "3:20 min", "1:05:00 h"."""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60}:{seconds % 60:02} min"
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} h"


def parse_bytes(text: str) -> int:
    """Returns the bytes that "4GB", "800MB" or "2GiB" stands for.

    Raises:
        ValueError: if it is something else, or not positive.
    """
    return round(quantity(text, SIZES, "a size such as 4GB or 800MB"))


def parse_seconds(text: str) -> float:
    """Returns the seconds that "90s", "5min" or "1.5h" stands for.

    Raises:
        ValueError: if it is something else, or not positive.
    """
    return quantity(text, UNITS, "a time such as 90s, 5min or 1.5h")


@dataclass(frozen=True)
class Cost:
    """Seconds that a step takes, as a linear function of the number of Gaussians."""

    base: float
    each: float  # per Gaussian

    def step(self, count):
        """Returns the seconds of a step with this many Gaussians, a number or an array."""
        return self.base + self.each * count


@dataclass(frozen=True)
class Costs:
    """Costs of steps with photos of half size, and of full size.

    Attributes:
        coarse: of steps with photos of half size.
        fine: of steps with photos of full size.
        plain: costs before the penalty on geometry begins; None if there is none, or if it begins at once.
        after: fraction of the run after which that penalty begins.
    """

    coarse: Cost
    fine: Cost
    plain: "Costs | None" = None
    after: float = 0.0

    def at(self, done: Float[np.ndarray, " k"], counts: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Returns the seconds of steps at fractions of the run, with these numbers of Gaussians."""
        steps = np.where(done < 1 / COARSE, self.coarse.step(counts), self.fine.step(counts))
        if self.plain is None:
            return steps
        return np.where(done < self.after, self.plain.at(done, counts), steps)

    def rest(self, done: float, first: int, most: int) -> float:
        """Returns the mean seconds of a step, times the fraction of the run that is left.

        Args:
            done: fraction of the run of the recipe `default` that is made, in [0, 1].
            first: Gaussians at the start.
            most: Gaussians that the run grows to.
        """
        middles = done + (1 - done) * (np.arange(PARTS) + 0.5) / PARTS
        counts = first * (max(most, first) / first) ** np.minimum(middles * GROWING, 1)
        return float(self.at(middles, counts).mean() * (1 - done))

    def run(self, steps: int, first: int, most: int) -> float:
        """Returns the seconds for a run of the recipe `default` that grows to `most` Gaussians."""
        programs = np.log(max(most / first, 1)) / np.log(GROWTH) + 2
        return float(steps * self.rest(0.0, first, most) + COMPILING * programs)


def measured(size: tuple[int, int], recipe: Recipe, lens: Lens = Pinhole()) -> Costs:
    """Measures the cost of steps on procedural scenes, which takes a few seconds.

    Args:
        size: of the photos, width and height in pixels.
        recipe: of the run; its backend is timed.
        lens: of the photos.
    """
    recipe = recipe.on(backends.resolve(recipe.drawing.backend))
    after = recipe.objective.geometry.after

    def costs(recipe: Recipe) -> Costs:
        fine, smaller = cost_of(size, recipe, lens), coarse_size(size, recipe)
        return Costs(fine if smaller == size else cost_of(smaller, recipe, lens), fine)

    late = costs(recipe)
    return replace(late, plain=costs(recipe.at(0.0)), after=after) if after else late


def coarse_size(size: tuple[int, int], recipe: Recipe) -> tuple[int, int]:
    """Returns the size of photos in the first steps of a recipe."""
    divisor = recipe.resolution.divisor(1, size)
    return size[0] // divisor, size[1] // divisor


def cost_of(size: tuple[int, int], recipe: Recipe, lens: Lens) -> Cost:
    """Returns the cost of a step with photos of a size by a lens, from two procedural scenes."""
    seconds = []
    for count in PROBES:
        work = operation(procedural(count, size, lens=lens), recipe)
        timed(work)  # compiles
        seconds.append(min(timed(work) for _ in range(ROUNDS)) / 1e3)
    each = max((seconds[1] - seconds[0]) / (PROBES[1] - PROBES[0]), 0.0)
    return Cost(HEAVIER * max(seconds[0] - each * PROBES[0], 1e-4), HEAVIER * each)


@dataclass(frozen=True)
class Plan:
    """Numbers of steps and Gaussians that fit into a time."""

    steps: int
    max_gaussians: int


@dataclass(frozen=True)
class Bounds:
    """Upper limits of a plan.

    Attributes:
        room: number of Gaussians of a run of few steps.
        ample: number of Gaussians of any run; None for `room`.
        steps: number of steps.
    """

    room: int
    ample: int | None = None
    steps: int = UNLIMITED


def longest_run(views: int) -> int:
    """Returns the most steps of a run for a time, from the number of its training views."""
    return max(MOST_VISITS * views, FEWEST_STEPS)


def bounds_of(views: int, most: int, fit: int | float) -> Bounds:
    """Returns the upper limits of a plan for a capture.

    Args:
        views: number of its training views.
        most: number of Gaussians of a run of few steps.
        fit: number of Gaussians that there is memory for.
    """
    return Bounds(most, int(min(DENSEST * most, fit, max(MOST, most))), longest_run(views))


def plan(costs: Costs, seconds: int | float, first: int, bounds: Bounds, most: int | None = None) -> Plan:
    """Plans the most steps that fit into a time, with as many Gaussians as they can train, or as are given.

    A run of few steps grows to `GAUSSIANS_PER_STEP` Gaussians for each step, up to `bounds.room`. A run with
    many steps for each of these goes beyond them: to `DENSER_PER_STEP` for each step, up to `bounds.ample`.

    Args:
        costs: of a step on this machine.
        seconds: for the whole run.
        first: Gaussians at the start.
        bounds: upper limits of the plan.
        most: the number of Gaussians to grow to; None to choose it.
    """
    room, ample = bounds.room, bounds.ample or bounds.room

    def gaussians(steps: int) -> int:
        taught = GAUSSIANS_PER_STEP * steps // ROUND * ROUND
        denser = min(DENSER_PER_STEP * steps // ROUND * ROUND, ample)
        return most or int(max(np.clip(taught, min(first, room), room), denser))

    low, high = FEWEST_STEPS, bounds.steps
    while low < high:  # the most steps that fit
        middle = (low + high + 1) // 2
        if costs.run(middle, min(first, gaussians(middle)), gaussians(middle)) <= seconds:
            low = middle
        else:
            high = middle - 1
    return Plan(low, gaussians(low))
