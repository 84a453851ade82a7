"""Rigid transforms as 4 x 4 matrices, and the twists that generate them."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

SMALL = 1e-4  # squared radians below which the series is exact to float32


@partial(jax.jit, inline=True)  # as in quaternions.py
@jax.default_matmul_precision("highest")
def exponential(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Returns the exponential of a twist (w, v): a rotation by |w| radians about w, and a translation V v.

        R = I + a K + b K^2,   V = I + b K + c K^2,   K = [w]x,
        a = sin t / t,   b = (1 - cos t) / t^2,   c = (t - sin t) / t^3,   t = |w|.

    To first order, a point p moves to p + w x p + v. The function is exact and differentiable at zero.
    """
    (x, y, z), v = twist[:3], twist[3:]
    a, b, c = _coefficients(x * x + y * y + z * z)
    zero = jnp.zeros_like(x)
    cross = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    identity, square = jnp.eye(3, dtype=twist.dtype), cross @ cross
    rotation = identity + a * cross + b * square
    translation = (identity + b * cross + c * square) @ v
    top = jnp.concatenate([rotation, translation[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], twist.dtype)])


def _coefficients(squared: Float[Array, ""]):
    """Returns a, b and c as functions of t^2, by their series if t is small."""
    small = squared < SMALL
    safe = jnp.where(small, 1, squared)
    t = jnp.sqrt(safe)
    a = jnp.where(small, 1 - squared / 6, jnp.sin(t) / t)
    b = jnp.where(small, 1 / 2 - squared / 24, (1 - jnp.cos(t)) / safe)
    c = jnp.where(small, 1 / 6 - squared / 120, (t - jnp.sin(t)) / (safe * t))
    return a, b, c
