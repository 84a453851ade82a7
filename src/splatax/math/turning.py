"""Rotation of spherical harmonics by a rotation that may be traced; `jax.vmap` maps over many."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.math import harmonics

SAMPLES = 2  # directions for each coefficient


def turned(sh: Float[Array, "k 3"], rotation: Float[Array, "3 3"]) -> Float[Array, "k 3"]:
    """Returns rotated coefficients: the function f' with f'(R d) = f(d). Differentiable in both arguments.

    The function is evaluated at directions R^-1 d, and the coefficients that give these values at d are
    solved for. A rotation maps each band of harmonics to itself, so the solution is exact except for
    rounding.
    """
    degree = harmonics.degree_of(sh.shape[0])
    if degree == 0:
        return sh
    directions, inverse = _solver(degree)
    turned = jnp.asarray(directions, sh.dtype) @ rotation
    values = jax.vmap(lambda direction: harmonics.basis(direction, degree))(turned) @ sh
    return jnp.asarray(inverse, sh.dtype) @ values


@cache
def _solver(degree: int) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "k s"]]:
    """Returns directions on a Fibonacci spiral, and the pseudo-inverse of the harmonics there."""
    count = SAMPLES * harmonics.count(degree)
    z = (np.arange(count) + 0.5) * 2 / count - 1
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        at = np.asarray(jax.vmap(lambda d: harmonics.basis(d, degree))(jnp.asarray(directions)))
    return directions, np.linalg.pinv(at)
