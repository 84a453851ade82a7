"""The memory that a run may use, and the size of photos that suits a short one."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from splatax.ahead import cores
from splatax.dataset import Dataset
from splatax.errors import InputError
from splatax.io.datasets.decoding import PhotoDecoder
from splatax.io.photo_store import decoder_of
from splatax.runs import forecast
from splatax.runs.machine import busyness, physical_memory
from splatax.runs.results import SHOWN

ENOUGH_STEPS = 500  # of a budget: with fewer, smaller photos give better scenes
SMALLEST_SIDE = 640  # pixels of the longer side that photos are not made smaller than for it
WRITING, SCORING = 5.0, 2e-6  # seconds to write results on two cores, and more for each pixel that is scored
DECODING_FRACTION = 0.25  # of what is left of the limit: the most that decoding photos ahead may take
MACHINE_FRACTION = 0.8  # of the machine's memory, that large captures may take without a limit
PHOTO_FRACTION = 0.5  # of all memory, or of what is left of the limit: the most that decoded photos may take


@dataclass(frozen=True)
class Deadline:
    """The end of a whole command, of which training gets what the rest leaves.

    Attributes:
        at: end, seconds of the monotonic clock.
    """

    at: float

    def left(self, dataset: Dataset) -> float:
        """Returns the seconds that are left for training, at least 1: results have to be written too.

        Writing takes longer if other programs run, but gets at most half of the time.
        """
        views = dataset.test or dataset.train[:SHOWN]
        pixels = sum(view.camera.width * view.camera.height for view in views)
        left = self.at - time.monotonic()
        return max(left - busyness() * (WRITING + SCORING * pixels), left / 2, 1.0)


@dataclass(frozen=True)
class Room:
    """The memory of a run.

    Attributes:
        gaussians: the most that the scene may grow to.
        photos: bytes of decoded photos that are kept; the others are read again for each step.
        wanted: bytes of all decoded photos.
        decoding: bytes for the photos that threads decode at one time; None for a part of the machine's.
    """

    gaussians: int | float = math.inf
    photos: int | float = math.inf
    wanted: int = 0
    decoding: int | None = None

    def __str__(self) -> str:
        part = f"{gigabytes(self.photos)} of {gigabytes(self.wanted)} of photos"
        kept = "all photos" if self.photos >= self.wanted else part
        return f"room for {self.gaussians:,} Gaussians and {kept}"


def room_within(limit: int | None, dataset: Dataset, first: int, views: int = 1, devices: int = 1) -> Room:
    """Returns what a run may use of the memory.

    Args:
        limit: bytes of the whole process; None for what the machine has.
        dataset: the capture.
        first: Gaussians to start from.
        views: photos of a step that this process draws.
        devices: devices of this process.

    Raises:
        InputError: if not even the start fits.
    """
    width, height, wanted = forecast.photos(dataset)
    if limit is None:
        return Room(photos=PHOTO_FRACTION * (physical_memory() or math.inf), wanted=wanted)
    one = decoding_memory(dataset)
    step = {"views": views, "devices": devices, "around": forecast.fixed(dataset)}
    least = forecast.memory(first, width, height, **step) + one
    if limit < least:
        raise too_little(limit, least, first, dataset, views)
    more = min((cores() - 1) * one, round(DECODING_FRACTION * (limit - least)))
    photos = min(wanted, PHOTO_FRACTION * (limit - least - more))
    gaussians = forecast.most_gaussians(limit - one - more, width, height, round(photos), **step)
    return Room(gaussians, photos, wanted, one + more)


def too_little(limit: int, least: int, first: int, dataset: Dataset, views: int) -> InputError:
    """Returns the error about a limit of memory in which not even the start fits.

    Args:
        limit: bytes of the whole process.
        least: bytes that the start takes.
        first: Gaussians to start from.
        dataset: the capture.
        views: photos of a step that this process draws.
    """
    width, height, _ = forecast.photos(dataset)
    scene, ways_out = f"{first:,} Gaussians", ["make the photos smaller"]
    if dataset.block:
        scene = f"{scene} of the block, {len(dataset.block.context):,} fixed ones around them"
        ways_out = ["plan smaller blocks"]
    if views > 1:
        ways_out.append("use fewer photos in a step")
    return InputError(
        f"{gigabytes(limit)} of memory are too little: the start alone takes about {gigabytes(least)}, "
        f"with {scene} and photos of {width} x {height}. Give more, or {', or '.join(ways_out)}.",
        options=("memory", "downscale", *(("views",) if views > 1 else ())),
    )


def gaussians_here(dataset: Dataset, views: int = 1, devices: int = 1) -> int | float:
    """Returns the number of Gaussians that a run without a limit of memory has room for on this machine.

    Args:
        dataset: the capture.
        views: photos of a step that this process draws.
        devices: devices of this process.
    """
    machine = physical_memory()
    if machine is None:
        return math.inf
    width, height, wanted = forecast.photos(dataset)
    photos = min(wanted, round(PHOTO_FRACTION * machine))
    step = {"views": views, "devices": devices, "around": forecast.fixed(dataset)}
    return forecast.most_gaussians(round(MACHINE_FRACTION * machine), width, height, photos, **step)


def decoding_memory(dataset: Dataset) -> int:
    """Returns the bytes that reading one photo ahead takes, for the largest: decoding it, and the photo."""
    sizes = [
        (decoder.stored.memory if isinstance(decoder := decoder_of(view), PhotoDecoder) else 0)
        + forecast.channels(dataset) * view.camera.width * view.camera.height
        for view in dataset.train
    ]
    return max(sizes)


def gigabytes(size: int | float) -> str:
    """Returns a number of bytes in words."""
    return f"{size / 1e9:.2f} GB"


def smaller_photos(
    load: Callable[[int], Dataset], dataset: Dataset, steps: int
) -> tuple[int, Dataset] | None:
    """Returns the capture with smaller photos, and their divisor, where a budget has too few steps.

    A step takes about as long as its photo has pixels. None where there are steps enough, or photos are small
    already.

    Args:
        load: returns the capture with photos divided by a number.
        dataset: the capture at the size that was planned for.
        steps: number of steps that fit into the time at that size.
    """
    found, affordable = None, pixels(dataset) * steps / ENOUGH_STEPS
    for divisor in range(2, 9):
        if pixels(found[1] if found else dataset) <= affordable:
            break
        smaller = load(divisor)
        camera = smaller.train[0].camera
        if max(camera.width, camera.height) < SMALLEST_SIDE:
            break
        if pixels(smaller) < pixels(dataset):
            found = divisor, smaller
    return found


def pixels(dataset: Dataset) -> int:
    """Returns the number of pixels of the first training photo."""
    camera = dataset.train[0].camera
    return camera.width * camera.height
