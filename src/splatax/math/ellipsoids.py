"""Gaussians as ellipsoids in space and ellipses on the image, one at a time: `vmap` for many.

A covariance is kept as a factor F, with covariance F F^T, wherever that is possible: it cannot
lose its positive definiteness to rounding, and a determinant becomes a sum of squares.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.math import quaternions


def covariance_factor(quat: Float[Array, "4"], scale: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """R S, so that the covariance is Sigma = R S S^T R^T (Kerbl et al. 2023, Eq. 6)."""
    return quaternions.to_rotation(quat) * scale[None, :]


def determinant_of_rows(factor: Float[Array, "2 3"], variance: Float[Array, ""]) -> Float[Array, ""]:
    """det(F F^T + v I) for two rows f, g: |f x g|^2 + v (|f|^2 + |g|^2) + v^2.

    Written out as a sum of squares, it does not cancel for long thin ellipses as ac - b^2 does.
    """
    normal = jnp.cross(factor[0], factor[1])
    return normal @ normal + variance * jnp.sum(factor * factor) + variance * variance


def sqrt_conic(covariance: Float[Array, "3"], determinant: Float[Array, ""]) -> Float[Array, "3"]:
    """The upper triangular (u, v, w) with [[u, v], [0, w]]^T [[u, v], [0, w]] = covariance^-1.

    The squared Mahalanobis distance of an offset is then (u dx + v dy)^2 + (w dy)^2, a sum of
    squares: the usual a dx^2 + 2 b dx dy + c dy^2 loses all digits far along a thin ellipse.

    Args:
        covariance: (a, b, c) of [[a, b], [b, c]].
        determinant: a c - b^2, better known by the caller.
    """
    _, b, c = covariance
    u = jnp.sqrt(c / determinant)
    return jnp.array([u, -b * u / c, 1 / jnp.sqrt(c)])
