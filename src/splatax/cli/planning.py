"""What a run is planned by: the time that it may take, and the memory that there is."""

import math
from dataclasses import dataclass
from pathlib import Path

import splatax as sx
from splatax import forecast
from splatax.budget import Plan, measured, parse_seconds, plan, quantity
from splatax.cli.display import duration
from splatax.cli.options import load_scene
from splatax.cli.output import say
from splatax.cli.platform import physical_memory
from splatax.dataset import Dataset
from splatax.errors import InputError

UNITS = {"": 1.0, "b": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9, "mib": 2.0**20, "gib": 2.0**30}
ENOUGH_STEPS = 500  # of a budget: with fewer, smaller photos teach more
SMALLEST_SIDE = 640  # pixels of the longer side that photos are not made smaller than for it
PHOTOS_SHARE = 0.5  # of all memory, or of what is left of the limit: the most that decoded photos may take


def parse_budget(text: str) -> float:
    """Seconds from "90s", "5min" or "1.5h".

    Raises:
        InputError: if it is something else, or not positive.
    """
    try:
        return parse_seconds(text)
    except ValueError as error:
        raise InputError(f"--budget: {error}.") from error


def parse_bytes(text: str) -> int:
    """Bytes from "4GB", "800MB" or "2GiB".

    Raises:
        InputError: if it is something else, or not positive.
    """
    try:
        return round(quantity(text, UNITS, "a size such as 4GB or 800MB"))
    except ValueError as error:
        raise InputError(f"--memory: {error}.") from error


@dataclass(frozen=True)
class Room:
    """What there is memory for.

    Attributes:
        gaussians: the most that the scene may grow to.
        photos: bytes of decoded photos that are kept; the others are read again for each step.
    """

    gaussians: int | float = math.inf
    photos: int | float = math.inf


def room_within(limit: str | None, dataset: Dataset, first: int) -> Room:
    """What a run may use of the memory. Says so where that is less than it might want.

    Args:
        limit: of the whole process, as the user gives it; None for what the machine has.
        dataset: the capture.
        first: Gaussians to start from.

    Raises:
        InputError: if not even the start fits.
    """
    if limit is None:
        return Room(photos=PHOTOS_SHARE * (physical_memory() or math.inf))
    width, height, wanted = forecast.photos(dataset)
    total, least = parse_bytes(limit), forecast.memory(first, width, height)
    if total < least:
        raise InputError(
            f"--memory {limit}: the start alone takes about {gigabytes(least)}, with {first:,} Gaussians and "
            f"photos of {width} x {height}. Give more, or make the photos smaller: --downscale."
        )
    photos = min(wanted, PHOTOS_SHARE * (total - least))
    room = Room(forecast.most_gaussians(total, width, height, round(photos)), photos)
    kept = "all photos" if photos == wanted else f"{gigabytes(photos)} of {gigabytes(wanted)} of photos"
    say(f"within {gigabytes(total)}: room for {room.gaussians:,} Gaussians and {kept}")
    return room


def gigabytes(size: int | float) -> str:
    """In words."""
    return f"{size / 1e9:.2f} GB"


def within(seconds: int | float, recipe: sx.Recipe, dataset: sx.Dataset, room: int, most: int | None) -> Plan:
    """The numbers of steps and Gaussians that fit into a time, by the speed of this machine. Says them.

    Args:
        seconds: for the whole run.
        recipe: `default`, for some number of steps.
        dataset: the capture.
        room: how many Gaussians there may be.
        most: how many there shall be; None for as many as suit.
    """
    say("measuring the speed of this machine ...")
    camera = dataset.train[0].camera
    costs = measured((camera.width, camera.height), recipe)
    chosen = plan(costs, seconds, recipe.initialization.number(dataset), room, most)
    say(
        f"about {chosen.steps:,} steps and {chosen.max_gaussians:,} Gaussians in {duration(seconds)}, at "
        f"{1e3 * costs.fine.step(chosen.max_gaussians):.0f} ms a step in the end"
    )
    return chosen


def shrunk(scene: Path, dataset: sx.Dataset, steps: int) -> tuple[int, sx.Dataset] | None:
    """The capture with smaller photos, and what they are divided by, where a budget has too few steps.

    A step takes about as long as its photo has pixels. None where there are steps enough, or photos are
    small already.

    Args:
        scene: of the capture.
        dataset: at the size that was planned for.
        steps: that there is time for at that size.
    """
    found, affordable = None, pixels(dataset) * steps / ENOUGH_STEPS
    for divisor in range(2, 9):
        if pixels(found[1] if found else dataset) <= affordable:
            break
        smaller = load_scene(scene, divisor)
        camera = smaller.train[0].camera
        if max(camera.width, camera.height) < SMALLEST_SIDE:
            break
        if pixels(smaller) < pixels(dataset):
            found = divisor, smaller
    return found


def pixels(dataset: sx.Dataset) -> int:
    """Of a photo."""
    camera = dataset.train[0].camera
    return camera.width * camera.height
