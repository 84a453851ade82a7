"""Frames of colour and depth, and searches for the pose of a part in them."""

import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

import splatax as sx
from splatax.twins import RgbdFrame

WIDTH, HEIGHT = 6, 4


def test_the_points_of_a_frame_lie_where_its_camera_measured_them():
    pose = sx.look_at(jnp.array([1.0, -2.0, 0.5]), jnp.array([0.2, 0.1, 0.3]), jnp.array([0.0, 0.0, 1.0]))
    camera = sx.Camera.simple_pinhole(5.0, pose, WIDTH, HEIGHT)
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[1, 4], depth[3, 0], depth[2, 2], depth[0, 1] = 1.5, 2.5, np.nan, np.inf
    points = RgbdFrame(camera, np.zeros((HEIGHT, WIDTH, 3), np.float32), depth).points()
    matrix = np.asarray(pose, np.float64)
    local = points @ matrix[:3, :3].T + matrix[:3, 3]
    # The principal point is the middle of the image, and pixel centres are at halves.
    expected = [
        [(4.5 - 3) / 5 * 1.5, (1.5 - 2) / 5 * 1.5, 1.5],
        [(0.5 - 3) / 5 * 2.5, (3.5 - 2) / 5 * 2.5, 2.5],
    ]
    assert_allclose(local, expected, atol=1e-5)
