"""Principal axes of a covariance that is given by its factor, with derivatives; `jax.vmap` maps over many."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.math import quaternions

SWEEPS = 4  # of Jacobi's method: quadratic convergence reaches float32 in three
ALIKE = 1e-3  # relative difference of variances below which the direction of two axes is not determined


@jax.custom_jvp
def principal_axes(factor: Float[Array, "3 3"]) -> tuple[Float[Array, "4"], Float[Array, "3"]]:
    """Returns a rotation R and scales s with R diag(s)^2 R^T = F F^T, exactly except for rounding.

    One-sided Jacobi rotations of the columns of F (Hestenes 1958). Columns that are orthogonal already stay
    as they are, so a factor that is a rotation times a diagonal matrix keeps its axes and their order.

    The derivative is exact where all scales differ. Two equal scales leave the directions of their axes
    undetermined: the derivative of those directions fades to zero where the variances differ by less than
    `ALIKE`.

    Args:
        factor: F; at most one of its singular values is zero.

    Returns:
        A unit quaternion of R, and s.
    """
    quat, scales, _, _ = _decomposed(factor)
    return quat, scales


@principal_axes.defjvp
def _principal_axes_jvp(primals, tangents):
    (factor,), (d_factor,) = primals, tangents
    quat, scales, axes, turn = _decomposed(factor)
    change = axes.T @ d_factor @ turn  # of the orthogonal columns, in their own frame
    d_scales = jnp.diagonal(change)
    variances = scales * scales
    difference = variances[None, :] - variances[:, None]
    threshold = ALIKE * (variances[None, :] + variances[:, None])
    square = difference**2 + threshold**2
    safe = jnp.where(square > 0, square, 1)
    moved = change * scales[None, :] + change.T * scales[:, None]
    spin = jnp.where(square > 0, moved * difference / safe, 0)  # antisymmetric: R' = R spin
    half = 0.5 * jnp.array([0, spin[2, 1], spin[0, 2], spin[1, 0]], factor.dtype)
    return (quat, scales), (quaternions.multiply(quat, half), d_scales)


def _decomposed(factor: Float[Array, "3 3"]):
    """Returns the quaternion and scales, the matrix of axes R, and V with F V = R diag(s)."""
    stacked = jnp.concatenate([factor, jnp.eye(3, dtype=factor.dtype)])  # V gets the turns of F
    columns = [stacked[:, 0], stacked[:, 1], stacked[:, 2]]
    for _ in range(SWEEPS):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            columns[i], columns[j] = _made_orthogonal(columns[i], columns[j])
    stacked = jnp.stack(columns, axis=1)
    orthogonal, turn = stacked[:3], stacked[3:]
    scales = jnp.sqrt(jnp.sum(orthogonal * orthogonal, axis=0))
    units = orthogonal / jnp.where(scales > 0, scales, 1)[None, :]
    # The least axis follows from the others, so that the axes are a rotation even if it has no length.
    least = jnp.argmin(scales)
    third = jnp.cross(units[:, (least + 1) % 3], units[:, (least + 2) % 3])
    axes = jnp.where(jnp.arange(3)[None, :] == least, third[:, None], units)
    # A reflection turns the third axis around, which leaves the covariance as it is.
    sign = jnp.where(jnp.sum(units[:, least] * third) < 0, -1, 1).astype(factor.dtype)
    turn = turn * jnp.where(jnp.arange(3)[None, :] == least, sign, jnp.ones_like(sign))
    return quaternions.from_rotation(axes), scales, axes, turn


def _made_orthogonal(a: Float[Array, "6"], b: Float[Array, "6"]):
    """Turns two columns in their plane until their upper halves are orthogonal."""
    inner, squares = a[:3] @ b[:3], (a[:3] @ a[:3], b[:3] @ b[:3])
    apart = jnp.abs(inner) > 1e-7 * jnp.sqrt(squares[0] * squares[1])
    zeta = (squares[1] - squares[0]) / (2 * jnp.where(apart, inner, 1))
    tangent = jnp.where(zeta < 0, -1, 1) / (jnp.abs(zeta) + jnp.sqrt(1 + zeta * zeta))
    tangent = jnp.where(apart, tangent, 0)
    cosine = 1 / jnp.sqrt(1 + tangent * tangent)
    sine = cosine * tangent
    return cosine * a - sine * b, sine * a + cosine * b
