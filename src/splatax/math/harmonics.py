"""Real spherical harmonics, in the order and signs of 3D Gaussian Splatting files.

The signs include the Condon-Shortley phase, and the order is band by band with m = -l .. l, as in the
authors' code of Kerbl et al. 2023 and in the KHR_gaussian_splatting specification. Bands 0 to 4 are
supported (Sloan 2013, "Efficient Spherical Harmonic Evaluation").
"""

import math
from functools import cache, partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

AnyArray = TypeVar("AnyArray", Array, np.ndarray)
Matrix = Float[np.ndarray, "3 3"] | Float[Array, "3 3"]

MAX_DEGREE = 4
SAMPLES = 64  # directions at which a rotation is fitted
Y00 = 0.28209479177387814  # 1 / (2 sqrt(pi)): the constant harmonic


def count(degree: int) -> int:
    """Returns the number of coefficients of a channel, (degree + 1)^2."""
    return (degree + 1) ** 2


def degree_of(coefficients: int) -> int:
    """Returns the degree that has this many coefficients per channel.

    Raises:
        ValueError: if no degree from 0 to 4 has that many.
    """
    degree = math.isqrt(coefficients) - 1
    if coefficients < 1 or count(degree) != coefficients or degree > MAX_DEGREE:
        raise ValueError(
            f"{coefficients} SH coefficients: expected 1, 4, 9, 16 or 25 (degree 0 to {MAX_DEGREE})"
        )
    return degree


@partial(jax.jit, static_argnames="degree", inline=True)  # as in quaternions.py
def basis(direction: Float[Array, "3"], degree: int) -> Float[Array, " k"]:
    """Returns the (degree + 1)^2 basis functions at a unit direction, from the camera to the Gaussian."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [jnp.full_like(x, Y00)],
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        [
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ],
    ]
    return jnp.stack([value for band in bands[: degree + 1] for value in band])


def degree_of_file(columns: int) -> int | None:
    """Returns the degree of a file with this number of `f_rest` columns; None if no degree has that many.

    The columns hold all coefficients of three channels except the first of each.
    """
    return {3 * (count(degree) - 1): degree for degree in range(MAX_DEGREE + 1)}.get(columns)


def evaluate(sh: Float[Array, "k c"], direction: Float[Array, "3"]) -> Float[Array, " c"]:
    """Returns the sum of coefficients times basis functions at a unit direction, for each channel."""
    return basis(direction, degree_of(sh.shape[0])) @ sh


def rotation(matrix: Matrix, degree: int) -> Float[np.ndarray, "k k"] | Float[Array, "k k"]:
    """Returns the matrix M that rotates coefficients: sh' = M sh gives a function with f'(R d) = f(d).

    M is block-diagonal, with one Wigner D matrix for each band, since a band is closed under rotation.
    Each block solves Y(R^-1 d) = Y(d) M, at more directions d than it has basis functions; it is exact except
    for rounding. A NumPy matrix is computed in double precision. A JAX array may be traced.

    Args:
        matrix: R, a rotation matrix.
        degree: degree of the coefficients.
    """
    directions, inverse, blocks = _samples(degree)
    at = jax.vmap(lambda direction: basis(direction, degree))
    if isinstance(matrix, np.ndarray):
        with jax.ensure_compile_time_eval(), jax.enable_x64(True):
            return blocks * (inverse @ np.asarray(at(jnp.asarray(directions @ matrix))))
    dtype = matrix.dtype
    with jax.default_matmul_precision("highest"):
        turned = at(jnp.asarray(directions, dtype) @ matrix)
        return jnp.asarray(blocks, dtype) * (jnp.asarray(inverse, dtype) @ turned)


@cache
def _samples(
    degree: int,
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "k s"], Float[np.ndarray, "k k"]]:
    """Returns directions, the pseudo-inverses of the bands' basis functions, and a mask of the blocks."""
    z = (np.arange(SAMPLES) + 0.5) * 2 / SAMPLES - 1
    angle = np.pi * (1 + 5**0.5) * np.arange(SAMPLES)  # a Fibonacci spiral
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        here = np.asarray(jax.vmap(lambda d: basis(d, degree))(jnp.asarray(directions)))
    band = np.sqrt(np.arange(count(degree))).astype(int)
    inverse = np.concatenate([np.linalg.pinv(here[:, band == b]) for b in range(degree + 1)])
    return directions, inverse, (band[:, None] == band[None, :]).astype(np.float64)


def from_rgb(rgb: AnyArray) -> AnyArray:
    """Returns the DC coefficient whose colour, Y00 * dc + 0.5, is `rgb` in every direction."""
    return (rgb - 0.5) / Y00


def to_rgb(dc: AnyArray) -> AnyArray:
    """Returns the colour of a DC coefficient, which is the same in every direction."""
    return dc * Y00 + 0.5
