import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from splatax.math import quaternions


def test_rotation_is_scipys_for_quaternions_of_any_length():
    quats = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32) * 3
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    assert_allclose(jax.vmap(quaternions.to_rotation)(quats), expected, atol=1e-6)


def test_zero_quaternion_is_no_rotation_and_has_a_zero_gradient():
    zero = jnp.zeros(4)
    assert_array_equal(quaternions.to_rotation(zero), np.eye(3))
    assert_array_equal(jax.jacobian(quaternions.to_rotation)(zero), 0)
