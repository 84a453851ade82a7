"""Stable orders of integer keys from sorts of single 32-bit words.

XLA sorts one array of words several times faster than pairs of arrays on CPU. A key is therefore cut into
digits, and each digit is packed above the position of its row. One word sort per digit, least significant
first, yields a stable order (an LSD radix sort with a large radix).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from splatax.varying import vary_together

WORD_BITS = 32


def bits_for(count: int) -> int:
    """Returns the number of bits that distinguish `count` values, at least one."""
    return max(1, (count - 1).bit_length())


def stable_order(keys: UInt32[Array, " n"]) -> Int[Array, " n"]:
    """Returns the permutation that sorts keys in ascending order and keeps equal keys in their order.

    The number of passes depends on the largest key, so small keys are cheap.
    """
    position_bits = bits_for(keys.shape[0])
    digit_bits = WORD_BITS - position_bits
    position = jnp.arange(keys.shape[0], dtype=jnp.uint32)

    def more_digits(carry):
        return jnp.any(carry[1] > 0)

    def sort_by_next_digit(carry):
        order, rest = carry
        digit = rest[order] & jnp.uint32((1 << digit_bits) - 1)
        words = lax.sort((digit << position_bits) | position, is_stable=False)
        return order[words & jnp.uint32((1 << position_bits) - 1)], rest >> digit_bits

    order, _ = lax.while_loop(more_digits, sort_by_next_digit, vary_together(position, keys))
    return order.astype(jnp.int32)


def depth_order(depths: Float[Array, " n"], visible: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Returns the rows by increasing depth, ties in their order, invisible ones last.

    It compares all bits of a float32 depth, because positive floats sort like their bit patterns.
    """
    if depths.dtype != jnp.float32:
        return jnp.argsort(jnp.where(visible, depths, jnp.inf), stable=True).astype(jnp.int32)
    bits = lax.bitcast_convert_type(depths, jnp.uint32)
    bits = bits - jnp.min(jnp.where(visible, bits, jnp.uint32(1 << 31)))
    farthest = jnp.max(jnp.where(visible, bits, jnp.uint32(0)))
    return stable_order(jnp.where(visible, bits, farthest + 1))
