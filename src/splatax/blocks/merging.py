"""Merging of trained blocks: of each block, the Gaussians inside its box."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatax.blocks.boxes import block_of, places_of
from splatax.blocks.parts import some
from splatax.blocks.plan import PLAN, Plan, folder_of, read_plan
from splatax.digests import file_digest
from splatax.errors import InputError
from splatax.gaussians import Gaussians, joined
from splatax.io import formats
from splatax.runs.checkpoints import files
from splatax.runs.records import read_record, understood

AGAIN = "Train the block again."


@dataclass(frozen=True)
class Kept:
    """The part of one block in the merged scene.

    Attributes:
        block: its number.
        gaussians: number of Gaussians inside its box.
        trained: number of Gaussians of its run, those in the margin included.
    """

    block: int
    gaussians: int
    trained: int


def is_finished(run: Path) -> bool:
    """Returns whether the run in a folder has made all of its steps and written its results."""
    return not files(run) and all((run / name).is_file() for name in ("scene.ply", "config.json"))


def is_of_plan(city: Path, block: int) -> bool:
    """Returns whether the finished run of a block was made by the present plan.

    Raises:
        InputError: if the record of the run is damaged.
    """
    path = folder_of(city, block) / "config.json"
    record = read_record(path, AGAIN)
    with understood(path, AGAIN):
        start = record["recipe"]["initialization"]
        return (start.get("plan"), start.get("index")) == (file_digest(city / PLAN), block)


def merged(city: Path) -> tuple[Gaussians, list[Kept]]:
    """Returns the scene of all blocks, one block after another, and the part of each.

    The boxes are half open and cover the plane, so nothing is in the scene twice, and nothing inside the box
    of its block is lost.

    Raises:
        InputError: if blocks are not done, or were trained for another plan.
    """
    plan = read_plan(city)
    check_done(city, plan)
    parts, kept = [], []
    for number, (part, trained) in enumerate(_parts(city, plan)):
        parts.append(part)
        kept.append(Kept(number, len(part), trained))
    if not sum(map(len, parts)):
        raise InputError(f"{city}: the blocks have no Gaussian inside their boxes. Train them again.")
    return joined(parts), kept


def check_done(city: Path, plan: Plan) -> None:
    """Raises InputError, naming the blocks, if some are not done, or were trained for another plan."""
    numbers = range(len(plan.blocks))
    if missing := [number for number in numbers if not is_finished(folder_of(city, number))]:
        raise InputError(
            f"{city}: {_blocks(missing)} not trained to the end. Train each: splatax blocks train {city} "
            f"{missing[0]}."
        )
    if other := [number for number in numbers if not is_of_plan(city, number)]:
        raise InputError(
            f"{city}: {_blocks(other)} trained for another plan. Train each again: splatax blocks train "
            f"{city} {other[0]}."
        )


def _blocks(numbers: list[int]) -> str:
    if len(numbers) == 1:
        return f"block {numbers[0]} is"
    return f"blocks {', '.join(map(str, numbers))} are"


def _parts(city: Path, plan: Plan) -> Iterator[tuple[Gaussians, int]]:
    for number in range(len(plan.blocks)):
        scene = formats.load(folder_of(city, number) / "scene.ply")
        places = places_of(np.asarray(scene.means), plan.axes)
        yield some(scene, block_of(places, plan.boxes) == number), len(scene)
