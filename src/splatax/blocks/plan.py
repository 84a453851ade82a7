"""The plan of a large capture (a "city"): a JSON file that defines each block and how it is trained.

CITY/blocks.json      the plan
CITY/context.npy      which Gaussians of the coarse scene surround each block: a bit for each
CITY/coarse/          the run of the coarse scene, unless one was given
CITY/block-000/       the run of a block
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from splatax.blocks.boxes import Box
from splatax.digests import file_digest
from splatax.errors import FormatError, InputError
from splatax.gaussians import Gaussians
from splatax.io import formats
from splatax.io.files import replacing
from splatax.runs.records import read_record, understood, write_json

PLAN, CONTEXT = "blocks.json", "context.npy"
AGAIN = "Plan the blocks again."
UNBOUNDED = {"low": -np.inf, "high": np.inf}  # stands as null in the file


@dataclass(frozen=True)
class BlockPlan:
    """One block.

    Attributes:
        box: its box on the ground plane.
        photos: names of its training views.
        held_out: names of the held-out views that show it.
        gaussians: largest number of Gaussians of its run, those in the margin of the box included.
        steps: number of steps of its run.
    """

    box: Box
    photos: tuple[str, ...]
    held_out: tuple[str, ...]
    gaussians: int
    steps: int


@dataclass(frozen=True)
class Plan:
    """The blocks of a capture, and the settings that they share.

    Attributes:
        options: of the run of each block, by the names of the command line.
        capture: its fingerprint; see `training.fingerprints.fingerprint`.
        coarse: file of the coarse scene.
        coarse_digest: of the contents of that file.
        axes: of the ground plane: unit vectors in the world.
        blocks: the blocks.
    """

    options: Mapping[str, Any]
    capture: Mapping[str, Any]
    coarse: Path
    coarse_digest: str
    axes: Float[np.ndarray, "2 3"]
    blocks: tuple[BlockPlan, ...]

    @property
    def boxes(self) -> tuple[Box, ...]:
        """The boxes of all blocks, which divide the ground plane."""
        return tuple(block.box for block in self.blocks)


def write_plan(city: Path, plan: Plan, contexts: Sequence[Bool[np.ndarray, " n"]]) -> None:
    """Writes a plan, the file of the plan last.

    Args:
        city: folder of the plan.
        plan: the plan.
        contexts: for each block, which Gaussians of the coarse scene surround it.
    """
    with replacing(city / CONTEXT) as file:
        np.save(file, np.packbits(np.stack(contexts), axis=1))
    blocks = [
        {
            "block": index,
            "low": block.box.low,
            "high": block.box.high,
            "margin": block.box.margin,
            "gaussians": block.gaussians,
            "steps": block.steps,
            "photos": block.photos,
            "held_out": block.held_out,
        }
        for index, block in enumerate(plan.blocks)
    ]
    inside = plan.coarse.is_relative_to(city)
    contents = {
        "capture": plan.capture,
        "options": plan.options,
        "coarse": str(plan.coarse.relative_to(city) if inside else plan.coarse.absolute()),
        "coarse_digest": plan.coarse_digest,
        "context_digest": file_digest(city / CONTEXT),
        "ground_axes": plan.axes.tolist(),
        "blocks": blocks,
    }
    write_json(city / PLAN, contents)


def read_plan(city: Path) -> Plan:
    """Reads the plan of a city.

    Raises:
        InputError: if there is none, or it is damaged.
    """
    path = city / PLAN
    if not path.is_file():
        raise InputError(f"{city}: no {PLAN} in it. Plan the blocks first: splatax blocks plan.")
    contents = read_record(path, AGAIN)
    with understood(path, AGAIN):
        blocks = []
        for index, block in enumerate(contents["blocks"]):
            if block["block"] != index:
                raise ValueError(f"block {block['block']} is not number {index}")
            box = Box(_corner(block, "low"), _corner(block, "high"), _pair(block["margin"]))
            names = tuple(map(str, block["photos"])), tuple(map(str, block["held_out"]))
            blocks.append(BlockPlan(box, *names, int(block["gaussians"]), int(block["steps"])))
        axes = np.array(contents["ground_axes"], np.float64).reshape(2, 3)
        if not blocks:
            raise ValueError("no blocks")
        return Plan(
            dict(contents["options"]),
            dict(contents["capture"]),
            city / contents["coarse"],
            str(contents["coarse_digest"]),
            axes,
            tuple(blocks),
        )


def check_number(plan: Plan, city: Path, block: int) -> None:
    """Raises InputError if the plan has no block of this number."""
    if not 0 <= block < len(plan.blocks):
        raise InputError(f"{city}: has no block {block}. Its blocks are 0 to {len(plan.blocks) - 1}.")


def read_coarse(plan: Plan) -> Gaussians:
    """Reads the coarse scene of a plan.

    Raises:
        InputError: if it is missing, or is not the one that was planned with.
    """
    if not plan.coarse.is_file():
        raise InputError(f"{plan.coarse}: the coarse scene of the plan is missing. {AGAIN}")
    if file_digest(plan.coarse) != plan.coarse_digest:
        raise InputError(
            f"{plan.coarse}: the coarse scene has changed since the blocks were planned. {AGAIN}"
        )
    return formats.load(plan.coarse)


def read_context(city: Path, block: int, count: int) -> Bool[np.ndarray, " n"]:
    """Returns which of so many Gaussians of the coarse scene surround a block.

    Raises:
        InputError: if the file is missing, or is not the one of the plan.
    """
    path = city / CONTEXT
    if not path.is_file():
        raise InputError(f"{path}: missing. {AGAIN}")
    if file_digest(path) != read_record(city / PLAN, AGAIN).get("context_digest"):
        raise FormatError(f"{path}: not that of the plan. {AGAIN}")
    with understood(path, AGAIN):
        bits = np.load(path, mmap_mode="r")[block]
        return np.unpackbits(bits, count=count).astype(bool)


def folder_of(city: Path, block: int) -> Path:
    """Returns the folder of the run of a block."""
    return city / f"block-{block:03}"


def _corner(block: Mapping[str, Any], name: str) -> tuple[float, float]:
    return _pair([UNBOUNDED[name] if value is None else value for value in block[name]])


def _pair(values: Sequence[float]) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)
