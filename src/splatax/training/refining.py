"""Density control between two steps: a strategy plans from a few columns, and all rows follow its plan.

    columns of all rows  ->  plan, on the host  ->  each new row from that of its parent, on its own device

No device holds more of the scene than its own rows, the old and the new ones.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.training.capacity import across, bucket_for, only
from splatax.training.devices import BLOCK, EVERYWHERE, ROWS, Sharding, is_by_row
from splatax.training.optimizer import restarted
from splatax.training.protocols import DensityPlan, DensityStrategy, HostOrDevice, UpdateRule
from splatax.training.recipes import Recipe
from splatax.training.routes import Routes, fetch, routes


class Kept(NamedTuple):
    """The part of a run's state that density control changes."""

    gaussians: Gaussians
    opt_state: Any
    density_state: Any


class NewRows(NamedTuple):
    """A plan by row of the refined scene, with its empty slots; see `DensityPlan`."""

    living: Bool[HostOrDevice, " m"]
    newborn: Bool[HostOrDevice, " m"]
    given: Any


@dataclass(frozen=True)
class Manner:
    """The manner in which rows are made from those of their parents. Static under `jit`.

    Attributes:
        density: the strategy.
        rule: of the optimizer.
        restarted: fields whose optimizer state starts anew.
        observes_anew: whether the state of the strategy starts anew.
    """

    density: DensityStrategy
    rule: UpdateRule
    restarted: tuple[str, ...]
    observes_anew: bool


class Due(NamedTuple):
    """A refinement that is due; see `DensityStrategy.plan`."""

    step: int
    extent: float
    key: PRNGKeyArray


def planned(columns: Any, count: int, due: Due, recipe: Recipe) -> DensityPlan:
    """Returns the plan of a refinement, from columns of all rows in order, `count` of which are living."""
    living = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], columns)
    return recipe.density.plan(living, due.step, due.extent, due.key)


def rows_after(plan: DensityPlan, rows: int) -> int:
    """Returns the number of rows of the refined scene, with its empty slots, from that before."""
    return bucket_for(plan.count, rows, plan.most)


def manner_of(plan: DensityPlan, recipe: Recipe) -> Manner:
    """Returns how the rows of a plan are made."""
    return Manner(recipe.density, recipe.optimizer.rule, plan.restarted, plan.observes_anew)


def new_rows(plan: DensityPlan, rows: int) -> NewRows:
    """Returns a plan for so many rows, of which the last ones are empty slots."""
    return NewRows(
        np.arange(rows) < plan.count,
        _padded(plan.newborn, rows),
        jax.tree.map(partial(_padded, rows=rows), plan.given),
    )


def parents_of(plan: DensityPlan, rows: int) -> Int[np.ndarray, " m"]:
    """Returns the parent of each of so many rows; that of an empty slot is the first row."""
    return _padded(plan.parents, rows)


def _padded(leaf: np.ndarray, rows: int) -> np.ndarray:
    return np.pad(leaf, [(0, rows - len(leaf))] + [(0, 0)] * (leaf.ndim - 1))


def on_one_device(kept: Kept, plan: DensityPlan, rows: int, recipe: Recipe) -> Kept:
    """Returns the refined state with so many rows, from one whose rows are on one device, in order."""
    return _on_one_device(kept, parents_of(plan, rows), new_rows(plan, rows), manner_of(plan, recipe))


def on_devices(kept: Kept, plan: DensityPlan, rows: int, recipe: Recipe, sharding: Sharding) -> Kept:
    """Returns the refined state with so many rows, from one whose rows are on devices.

    The scene does not depend on the number of devices, for the reasons given in `splatax.training.devices`.
    """
    ways, new = sent(plan, len(kept.gaussians), rows, sharding)
    return _on_devices(kept, ways, new, manner_of(plan, recipe), sharding.mesh)


def sent(plan: DensityPlan, before: int, rows: int, sharding: Sharding) -> tuple[Routes, NewRows]:
    """Sends a plan to the devices: to each, the part of its own rows.

    Args:
        plan: of a refinement.
        before: rows of all devices, with empty slots.
        rows: of the refined scene, with empty slots.
        sharding: the devices.
    """
    rows = sharding.rows_for(rows)
    ways = routes(plan.parents, sharding.mesh.size, before, rows)
    new = jax.tree.map(sharding.rows, new_rows(plan, rows))
    return jax.tree.map(sharding.by_first_axis, ways), new


@partial(jax.jit, static_argnames="manner")
def _on_one_device(kept: Kept, parents: Int[Array, " m"], new: NewRows, manner: Manner) -> Kept:
    rows = len(kept.gaussians)
    taken = jax.tree.map(lambda leaf: leaf[parents] if is_by_row(leaf, rows) else leaf, kept)
    return _made(taken, new, manner)


@partial(jax.jit, static_argnames=("manner", "mesh"))
def _on_devices(kept: Kept, ways: Routes, new: NewRows, manner: Manner, mesh: Mesh) -> Kept:
    places = jax.tree.map(lambda leaf: ROWS if is_by_row(leaf, len(kept.gaussians)) else EVERYWHERE, kept)
    is_row = [place == ROWS for place in jax.tree.leaves(places)]

    def on_each(kept: Kept, ways: Routes, new: NewRows) -> Kept:
        leaves, tree = jax.tree.flatten(kept)

        def block(each):
            sent, taken, new = each
            found = [
                fetch(leaf, sent, taken) if row else leaf for leaf, row in zip(leaves, is_row, strict=True)
            ]
            return jax.tree.leaves(_made(jax.tree.unflatten(tree, found), new, manner))

        blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, BLOCK, *leaf.shape[1:]), new)
        made = lax.map(block, (ways.sent[0], ways.taken[0], blocks))
        # What is not by row, such as a step count, is equal after every block.
        joined = [
            leaf.reshape(-1, *leaf.shape[2:]) if row else leaf[0]
            for leaf, row in zip(made, is_row, strict=True)
        ]
        return jax.tree.unflatten(tree, joined)

    return jax.shard_map(
        on_each, mesh=mesh, in_specs=(places, ROWS, ROWS), out_specs=places, check_vma=False
    )(kept, ways, new)


def _made(parents: Kept, new: NewRows, manner: Manner) -> Kept:
    """Returns rows of the refined state, from those of their parents. Each row is made independently."""
    rows, living = len(new.living), jnp.asarray(new.living)
    gaussians = manner.density.reborn(parents.gaussians, parents.density_state, new.given)
    gaussians = only(gaussians, living)
    anew = jnp.asarray(new.newborn) | ~living
    opt_state = restarted(parents.opt_state, anew, manner.restarted, gaussians, manner.rule)
    first = manner.density.init(rows)
    if manner.observes_anew:
        return Kept(gaussians, opt_state, first)

    def followed(leaf, start):
        if not is_by_row(leaf, rows):
            return leaf
        return jnp.where(across(living, leaf.ndim), leaf, start)

    return Kept(gaussians, opt_state, jax.tree.map(followed, parents.density_state, first))
