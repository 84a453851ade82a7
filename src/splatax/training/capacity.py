"""Arrays with spare rows, so that a scene that grows to n Gaussians compiles O(log n) programs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from splatax.gaussians import Gaussians, is_sound

GROWTH = 2
SMALLEST = 1024


def bucket_for(count: int, current: int = SMALLEST, most: int | None = None) -> int:
    """Returns the number of rows for `count` Gaussians.

    Args:
        count: number of living Gaussians.
        current: rows that there are; they are doubled until the Gaussians fit.
        most: number that the scene will never exceed, if that is known; the rows do not exceed it either.
    """
    if most is not None and current < count <= most:
        return min(bucket_for(count, current), most)
    while current < count:
        current *= GROWTH
    return current


def pad(gaussians: Gaussians, capacity: int) -> Gaussians:
    """Appends empty slots up to `capacity` rows."""
    count = len(gaussians)
    padded = jax.tree.map(
        lambda leaf: jnp.pad(leaf, [(0, capacity - count)] + [(0, 0)] * (leaf.ndim - 1)), gaussians
    )
    return only(padded, jnp.arange(capacity) < count)


def without_broken(gaussians: Gaussians) -> tuple[Gaussians, int]:
    """Replaces each Gaussian that is not sound, see `gaussians.is_sound`, by an empty slot.

    Returns:
        The scene, and the number of Gaussians that were replaced.
    """
    good, broken = _sound(gaussians)
    return (only(gaussians, good) if int(broken) else gaussians), int(broken)


@jax.jit
def only(gaussians: Gaussians, kept: Bool[Array, " n"]) -> Gaussians:
    """Turns all rows but some into empty slots, which are exactly transparent: all else about them is 0."""
    cleared = jax.tree.map(lambda leaf: jnp.where(across(kept, leaf.ndim), leaf, 0), gaussians)
    return replace(cleared, opacity_logits=jnp.where(kept, gaussians.opacity_logits, -jnp.inf))


@jax.jit
def _sound(gaussians: Gaussians) -> tuple[Bool[Array, " n"], Int[Array, ""]]:
    """Returns which rows are sound, and the number of the others."""
    good = jax.vmap(is_sound)(*jax.tree.leaves(gaussians))
    return good, jnp.sum(~good)


def across(rows: Bool[Array, " n"], axes: int) -> Bool[Array, "n ..."]:
    """Returns a mask of rows with so many axes that it applies to all numbers of a row."""
    return rows.reshape(-1, *[1] * (axes - 1))
