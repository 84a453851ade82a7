"""Arrays a little larger than the scene, so that its growth compiles a program O(log n) times."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from splatax.gaussians import Gaussians

GROWTH = 1.5
SMALLEST = 1024


def bucket_for(count: int, current: int = SMALLEST) -> int:
    """The capacity for `count` Gaussians: `current` if they fit, else grown by halves until they do."""
    while current < count:
        current = -(-int(current * GROWTH) // 256) * 256
    return current


def pad(gaussians: Gaussians, capacity: int) -> Gaussians:
    """Appends empty slots."""
    count = len(gaussians)
    padded = jax.tree.map(
        lambda leaf: jnp.pad(leaf, [(0, capacity - count)] + [(0, 0)] * (leaf.ndim - 1)), gaussians
    )
    return with_empty_slots(padded, jnp.int32(count))


def with_empty_slots(gaussians: Gaussians, count: Int[Array, ""]) -> Gaussians:
    """The same rows, but those from `count` on are empty slots: exactly transparent."""
    living = jnp.arange(len(gaussians)) < count
    return replace(gaussians, opacity_logits=jnp.where(living, gaussians.opacity_logits, -jnp.inf))
