import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from splatax.math.neighbours import mean_squared_distances


def test_mean_squared_distance_to_the_three_nearest():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 0, 0]], np.float32)
    assert_allclose(mean_squared_distances(points)[0], (1 + 4 + 9) / 3)


def test_duplicates_have_distance_zero_and_few_points_use_what_there_is():
    assert_array_equal(mean_squared_distances(np.zeros((6, 3), np.float32)), 0)
    assert_allclose(mean_squared_distances(np.array([[0, 0, 0], [0, 0, 2]], np.float32)), [4, 4])
    assert_array_equal(mean_squared_distances(np.zeros((1, 3), np.float32)), [0])
