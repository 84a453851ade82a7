"""Planning: the boxes of a coarse scene, the views of each, and the size of each run."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from splatax.blocks.boxes import Box, block_of, cut, ground_axes, places_of
from splatax.blocks.plan import BlockPlan, Plan
from splatax.blocks.visibility import Outlook, outlooks
from splatax.cameras import rig
from splatax.dataset import Dataset, PointCloud
from splatax.digests import file_digest
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.training.fingerprints import fingerprint

COARSER = 4  # times fewer Gaussians than all blocks will have, and not more than one block
SHORTER = 5  # times fewer steps
LEAST_STEPS = 2_000  # of the coarse run, unless the blocks have fewer: its errors limit all blocks


@dataclass(frozen=True)
class Work:
    """The size of one run of the whole capture, which the blocks share.

    Attributes:
        gaussians: number of Gaussians that it would have at its end.
        steps: number of steps that it would make.
    """

    gaussians: int
    steps: int

    def coarse(self, blocks: int) -> "Work":
        """Returns the size of the coarse run for so many blocks."""
        gaussians = min(self.gaussians // COARSER, math.ceil(self.gaussians / blocks))
        steps = max(self.steps // SHORTER, min(self.steps, LEAST_STEPS))
        return Work(max(gaussians, blocks), max(steps, 1))


def thinned(points: PointCloud, count: int, seed: int) -> PointCloud:
    """Returns so many of the points, chosen at random; all of them if there are no more."""
    if len(points) <= count:
        return points
    rows = np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))
    return PointCloud(points.positions[rows], points.colors[rows])


def made_plan(
    dataset: Dataset,
    coarse: tuple[Path, Gaussians],
    count: int,
    work: Work,
    options: Mapping[str, Any],
    watch: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Plan, list[Bool[np.ndarray, " n"]]]:
    """Returns a plan of so many blocks, and for each the Gaussians of the coarse scene that surround it.

    Args:
        dataset: the whole capture.
        coarse: file of the coarse scene, and its contents.
        count: number of blocks.
        work: size of one run of the whole.
        options: of the runs.
        watch: called with the number of views that have been looked at, and of all.

    Raises:
        InputError: if the scene cannot be cut into so many blocks, or a block is seen in no photo.
    """
    path, gaussians = coarse
    if count > len(gaussians):
        raise InputError(f"{path}: {len(gaussians):,} Gaussians are too few for {count:,} blocks.")
    cameras = [view.camera for view in dataset.train]
    axes = ground_axes(np.asarray(gaussians.means), rig.up_of(cameras))
    places = places_of(np.asarray(gaussians.means), axes)
    boxes = cut(places, count)
    both = cameras, [view.camera for view in dataset.test]
    found = outlooks(gaussians, both, block_of(places, boxes), options["backend"], watch)
    blocks, contexts = [], []
    for number, (box, outlook) in enumerate(zip(boxes, found, strict=True)):
        if not len(outlook.train):
            raise InputError(f"No photo shows block {number} of {count}. Ask for fewer blocks.")
        start = box.trains(places)
        blocks.append(block_plan(dataset, box, outlook, work, float(start.mean())))
        contexts.append(outlook.seen & ~start)
    capture = fingerprint(dataset)
    return Plan(options, capture, path, file_digest(path), axes, tuple(blocks)), contexts


def block_plan(dataset: Dataset, box: Box, outlook: Outlook, work: Work, fraction: float) -> BlockPlan:
    """Returns the plan of one block, whose run makes as many steps for each photo as a run of the whole.

    Args:
        dataset: the whole capture.
        box: of the block.
        outlook: the views that show it.
        work: size of one run of the whole.
        fraction: of the Gaussians of the coarse scene that the block trains.
    """
    photos = tuple(dataset.train[index].name for index in outlook.train)
    held_out = tuple(dataset.test[index].name for index in outlook.test)
    gaussians = max(round(work.gaussians * fraction), 1)
    steps = max(round(work.steps * len(photos) / len(dataset.train)), 1)
    return BlockPlan(box, photos, held_out, gaussians, steps)
