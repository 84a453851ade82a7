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
    return with_empty_slots(padded, jnp.int32(count))


def with_empty_slots(gaussians: Gaussians, count: Int[Array, ""]) -> Gaussians:
    """Turns the rows from `count` on into empty slots, which are exactly transparent."""
    living = jnp.arange(len(gaussians)) < count
    return replace(gaussians, opacity_logits=jnp.where(living, gaussians.opacity_logits, -jnp.inf))


def without_broken(gaussians: Gaussians) -> tuple[Gaussians, int]:
    """Replaces each Gaussian that is not sound, see `gaussians.is_sound`, by an empty slot.

    Returns:
        The scene, and the number of Gaussians that were replaced.
    """
    good, broken = _sound(gaussians)
    return (_only(gaussians, good) if int(broken) else gaussians), int(broken)


def only(gaussians: Gaussians, kept: Bool[Array, " n"]) -> Gaussians:
    """Turns all rows but some into empty slots, of which all numbers are 0 but the opacity logit."""
    cleared = jax.tree.map(
        lambda leaf: jnp.where(kept.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0), gaussians
    )
    return replace(cleared, opacity_logits=jnp.where(kept, gaussians.opacity_logits, -jnp.inf))


_only = jax.jit(only)


@jax.jit
def _sound(gaussians: Gaussians) -> tuple[Bool[Array, " n"], Int[Array, ""]]:
    """Returns which rows are sound, and the number of the others."""
    good = jax.vmap(is_sound)(*jax.tree.leaves(gaussians))
    return good, jnp.sum(~good)
