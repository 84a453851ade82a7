"""Covariances of one Gaussian in space and on the image; `jax.vmap` maps the functions over many.

Where possible, a covariance is represented by a factor F, with covariance F F^T. F F^T stays positive
semi-definite whatever the rounding of F, and its determinant is a sum of squares.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.math import quaternions


def covariance_factor(quat: Float[Array, "4"], scale: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Returns the factor R S of the covariance Sigma = R S S^T R^T (Kerbl et al. 2023, Eq. 6)."""
    return quaternions.to_rotation(quat) * scale[None, :]


def determinant_of_rows(
    rows: Float[Array, "2 m"], weights: Float[Array, " m"], variance: Float[Array, ""]
) -> Float[Array, ""]:
    """Returns det(F diag(w) F^T + v I), where f and g are the rows of F, by the formula of Cauchy and Binet.

        sum_{i<j} w_i w_j (f_i g_j - f_j g_i)^2 + v sum_i w_i (f_i^2 + g_i^2) + v^2

    With positive weights, this sum of squares does not cancel for long thin ellipses, as a c - b^2 does.
    """
    first, second = np.triu_indices(rows.shape[1], 1)
    f, g = rows
    minors = f[first] * g[second] - f[second] * g[first]
    area = jnp.sum(weights[first] * weights[second] * minors * minors)
    return area + variance * jnp.sum(weights[None] * rows * rows) + variance * variance


def sqrt_conic(covariance: Float[Array, "3"], determinant: Float[Array, ""]) -> Float[Array, "3"]:
    """Returns the upper triangular (u, v, w) with [[u, v], [0, w]]^T [[u, v], [0, w]] = covariance^-1.

    The squared Mahalanobis distance of an offset is then the sum of squares (u dx + v dy)^2 + (w dy)^2.
    The usual a dx^2 + 2 b dx dy + c dy^2 loses all digits far along a thin ellipse.

    Args:
        covariance: (a, b, c) of [[a, b], [b, c]].
        determinant: a c - b^2, which the caller knows more precisely (see `determinant_of_rows`).
    """
    _, b, c = covariance
    u = jnp.sqrt(c / determinant)
    return jnp.array([u, -b * u / c, 1 / jnp.sqrt(c)])
