"""The parts of a coarse scene and of a capture that belong to one block."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from splatax.blocks.boxes import places_of
from splatax.blocks.plan import PLAN, check_number, read_coarse, read_context, read_plan
from splatax.dataset import Block, Dataset, View
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.runs.resume import differences
from splatax.training.checkpoint import fingerprint


def some(gaussians: Gaussians, rows: Bool[np.ndarray, " n"]) -> Gaussians:
    """Returns some rows of a scene, as arrays of JAX."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows]), gaussians)


def part_of(dataset: Dataset, city: Path, number: int) -> Dataset:
    """Returns the capture of one block: its views, its Gaussians to start from, and those around them.

    Args:
        dataset: the whole capture, loaded with the options of the plan.
        city: folder of the plan.
        number: of the block, from 0.

    Raises:
        InputError: if the plan or its files are missing or damaged, there is no such block, or the capture
            has changed since the blocks were planned.
    """
    plan = read_plan(city)
    check_number(plan, city, number)
    changes = "; ".join(differences(dict(plan.capture), fingerprint(dataset)))
    if changes:
        raise InputError(
            f"{city / PLAN}: the capture has changed since the blocks were planned: {changes}. Put it back "
            "as it was, or plan the blocks again."
        )
    block, coarse = plan.blocks[number], read_coarse(plan)
    places = places_of(np.asarray(coarse.means), plan.axes)
    start = some(coarse, block.box.trains(places))
    context = some(coarse, read_context(city, number, len(coarse)))
    train, test = named(dataset.train, block.photos), named(dataset.test, block.held_out)
    note = (
        f"block {number} of {len(plan.blocks)}: {len(train)} of {len(dataset.train)} photos, {len(start):,} "
        f"Gaussians to start from, {len(context):,} fixed ones around them"
    )
    notes = (*dataset.notes, note)
    return replace(dataset, train=train, test=test, notes=notes, block=Block(start, context))


def named(views: Sequence[View], names: Sequence[str]) -> tuple[View, ...]:
    """Returns the views with these names, in their order."""
    wanted = set(names)
    return tuple(view for view in views if view.name in wanted)
