"""Twists generate rigid transforms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from splatax.math import rigid


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.00999, 0.0101, 1.0, 3.0])
def test_a_twist_gives_the_exponential_of_its_matrix(x64, angle):
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    twist = jnp.asarray(np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(size=3)]))
    (x, y, z), v = twist[:3], twist[3:]
    generator = jnp.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])
    # The series stops at the fourth power of an angle of 0.01.
    assert_allclose(rigid.exponential(twist), jax.scipy.linalg.expm(generator), atol=1e-9)


def test_a_small_twist_moves_a_point_by_its_cross_product(x64):
    point = jnp.array([0.3, -2.0, 1.0])

    def moved(twist):
        transform = rigid.exponential(twist)
        return transform[:3, :3] @ point + transform[:3, 3]

    jacobian = jax.jacobian(moved)(jnp.zeros(6))
    expected = [np.cross(axis, point) for axis in np.eye(3)]
    assert_allclose(jacobian, np.concatenate([np.stack(expected, 1), np.eye(3)], 1), atol=1e-12)
