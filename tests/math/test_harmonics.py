"""Spherical harmonics, compared with SciPy and with the identities that define them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import sph_harm_y

from splatax.math import harmonics


def directions(n=4000):
    """Points spread evenly over the sphere (a Fibonacci spiral)."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (1 + 5**0.5) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def scipy_real_harmonic(degree, order, d):
    """Real combination of SciPy's complex harmonics, with the Condon-Shortley sign kept."""
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    complex_value = sph_harm_y(degree, abs(order), theta, phi)
    if order == 0:
        return complex_value.real
    return np.sqrt(2) * (complex_value.real if order > 0 else complex_value.imag)


def test_basis_is_scipys_in_every_band(x64):
    d = directions(50)
    values = jax.vmap(lambda v: harmonics.basis(v, harmonics.MAX_DEGREE))(jnp.asarray(d))
    column = 0
    for degree in range(harmonics.MAX_DEGREE + 1):
        for order in range(-degree, degree + 1):
            expected = scipy_real_harmonic(degree, order, d)
            assert_allclose(values[:, column], expected, atol=1e-12, err_msg=f"l={degree} m={order}")
            column += 1


def test_basis_is_orthonormal_over_the_sphere(x64):
    d = jnp.asarray(directions())
    values = jax.vmap(lambda v: harmonics.basis(v, harmonics.MAX_DEGREE))(d)
    gram = values.T @ values * (4 * np.pi / len(d))
    assert_allclose(gram, np.eye(25), atol=2e-3)  # the spiral's own quadrature error


def test_dc_shows_its_colour_from_everywhere():
    rgb = jnp.array([0.2, 0.5, 0.9])
    shown = harmonics.evaluate(harmonics.from_rgb(rgb)[None], jnp.array([0.6, 0.0, 0.8])) + 0.5
    assert_allclose(shown, rgb, rtol=1e-6)
    assert_allclose(harmonics.to_rgb(harmonics.from_rgb(rgb)), rgb, rtol=1e-6)


@pytest.mark.parametrize("coefficients", [0, 2, 15, 36])
def test_a_count_that_is_no_degree_is_refused(coefficients):
    with pytest.raises(ValueError, match="expected 1, 4, 9, 16 or 25"):
        harmonics.degree_of(coefficients)
