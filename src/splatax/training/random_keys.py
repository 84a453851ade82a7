"""Random keys among the leaves of a state: files, digests and other processes take them as integers."""

from typing import Any

import jax
import jax.numpy as jnp


def is_key(leaf: Any) -> bool:
    """Returns whether a leaf of a state, or its shape and dtype, is that of random keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def as_integers(leaf: Any) -> Any:
    """Returns random keys as integers, and other leaves as they are."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf
