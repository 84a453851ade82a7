"""`splatax plan`: what a training step would cost on many devices."""

import math
import re
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.table import Table

from splatax.cli.output import say, show
from splatax.errors import InputError
from splatax.runs.scaling import MACHINES, Cost, Machine, cost

SIZES = {"1080p": (1920, 1080), "4K": (3840, 2160), "8K": (7680, 4320)}
UNITS = {"": 1, "k": 1_000, "M": 1_000_000, "G": 1_000_000_000}


@dataclass(frozen=True)
class Plan:
    """Predict time, traffic and memory of a training step on many devices.

    "memory" is that of a device during a step or density control. "drawing" is that of the first device of
    each process when it draws a test view or a picture, with the Gaussians of all devices.

    The numbers come from a model, not from measurements: it counts bytes and divides them by assumed hardware
    rates. docs/scale.md states the assumptions.
    """

    devices: Annotated[str, tyro.conf.arg(metavar="NxKIND")] = "8xH100"
    """Number and kind of devices, for example 8xH100, 64xA100 or 4xCPU (a host with 16 cores each)."""
    gaussians: Annotated[str, tyro.conf.arg(metavar="N")] = "1M"
    """Number of Gaussians, for example 500k or 10M."""
    size: Annotated[str, tyro.conf.arg(metavar="SIZE")] = "1080p"
    """Size of a photo: 1080p, 4K, 8K, or WIDTHxHEIGHT."""
    seen: Annotated[float, tyro.conf.arg(metavar="FRACTION")] = 0.2
    """Fraction of the Gaussians that are visible in a photo."""

    def run(self) -> None:
        count, machine = devices_of(self.devices)
        gaussians, pixels = number_of(self.gaussians), math.prod(size_of(self.size))
        if not 0 < self.seen <= 1:
            raise InputError(f"--seen: a fraction above 0 and at most 1, not {self.seen}.")
        times = ("step, ms", "rows", "draw", "travel", "wait")
        # Without lines it fits a terminal of 80 columns.
        bytes_ = ("exchanged, GB", "memory, GB", "drawing, GB")
        table = Table("devices", *times, "photos/s", *bytes_, box=None, pad_edge=False, collapse_padding=True)
        numbers = sorted({1, min(machine.host, count), count})
        costs = {devices: cost(machine, devices, gaussians, pixels, self.seen) for devices in numbers}
        for devices, found in costs.items():
            table.add_row(*row(devices, found))
        say(
            f"a step of one photo of {self.size} for each {machine.name}; {gaussians:,} Gaussians, of which "
            f"a photo shows {self.seen:.0%}"
        )
        show(table)
        if small := [str(devices) for devices, found in costs.items() if found.peak > machine.room]:
            say(f"does not fit in the {machine.room:.0f} GB of a device: with {', '.join(small)} devices")
        say("predicted from assumed rates; no such machine was measured")


def row(devices: int, found: Cost) -> list[str]:
    """Returns the cells of a number of devices."""
    times = [f"{ms:.1f}" for ms in (found.step, found.rows, found.draw, found.travel, found.wait)]
    speed = f"{devices * 1e3 / found.step:,.0f}"
    sizes = f"{found.exchanged / 1e9:.2f}", f"{found.memory:.1f}", f"{found.state + found.whole:.1f}"
    return [str(devices), *times, speed, *sizes]


def devices_of(text: str) -> tuple[int, Machine]:
    """Reads a number and kind of devices.

    Raises:
        InputError: if the text is not one.
    """
    found = re.fullmatch(r"(\d+)x(\w+)", text)
    if not found or int(found[1]) < 1 or found[2] not in MACHINES:
        raise InputError(f"--devices {text}: a number and one of {', '.join(MACHINES)}, such as 8xH100.")
    return int(found[1]), MACHINES[found[2]]


def number_of(text: str) -> int:
    """Reads a number of Gaussians such as 10M.

    Raises:
        InputError: if the text is not one.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([kMG]?)", text)
    if not found or not float(found[1]):
        raise InputError(f"--gaussians {text}: a number above 0, such as 500k or 10M.")
    return round(float(found[1]) * UNITS[found[2]])


def size_of(text: str) -> tuple[int, int]:
    """Reads the size of a photo.

    Raises:
        InputError: if the text is not one.
    """
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if text in SIZES:
        return SIZES[text]
    if not found or not int(found[1]) * int(found[2]):
        raise InputError(f"--size {text}: one of {', '.join(SIZES)}, or WIDTHxHEIGHT.")
    return int(found[1]), int(found[2])
