"""Rotations as quaternions (w, x, y, z); `jax.vmap` maps the functions over many."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Outside of `jax.jit`, a function is one program instead of one for each of its operations.
_at_once = partial(jax.jit, inline=True)


@_at_once
def normalize(quat: Float[Array, "4"]) -> Float[Array, "4"]:
    """Returns the unit quaternion of the same rotation; zero stays zero, with a zero gradient."""
    squared = quat @ quat
    positive = squared > 0
    return jnp.where(positive, quat / jnp.sqrt(jnp.where(positive, squared, 1)), 0)


@_at_once
def multiply(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """Returns the Hamilton product a b, which is the rotation `b` followed by `a`."""
    w, x, y, z = a
    left = jnp.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return left @ b


@_at_once
def to_rotation(quat: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Returns the rotation matrix of a quaternion of any length. The zero quaternion gives the identity."""
    w, x, y, z = normalize(quat)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@_at_once
def from_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Returns a unit quaternion of a rotation matrix, with a derivative at every rotation.

    4 q q^T is linear in the matrix; its row with the largest diagonal element, normalized, is q or -q.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix
    outer = jnp.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    return normalize(outer[jnp.argmax(jnp.diagonal(outer))])
