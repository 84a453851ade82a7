"""Clips, compared with an independent evaluation by SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from scene.skeletons import arm
from splatax.scene.clips import Channel, Clip

TIMES = np.array([0.2, 0.5, 1.1, 2.0])
ROTATIONS = Rotation.random(4, random_state=3)
QUATS = ROTATIONS.as_quat()[:, [3, 0, 1, 2]]


def angle(quat, rotation) -> float:
    return float((Rotation.from_quat(np.asarray(quat)[[1, 2, 3, 0]]).inv() * rotation).magnitude())


@pytest.mark.parametrize("time", [0.2, 0.3, 0.5, 1.0, 1.7, 2.0])
def test_linear_rotations_go_the_shortest_way_at_constant_speed(time):
    signs = np.array([1, -1, 1, -1])[:, None]  # -q is the rotation q
    channel = Channel(0, "rotation", TIMES, (QUATS * signs)[:, None], "LINEAR")
    assert angle(channel.at(time), Slerp(TIMES, ROTATIONS)(time)) < 1e-6


@pytest.mark.parametrize("time", [0.2, 0.3, 0.5, 1.0, 1.7, 2.0])
def test_splines_are_those_of_hermite_with_tangents_in_units_per_second(time):
    rng = np.random.default_rng(1)
    keys, tangents = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    channel = Channel(0, "translation", TIMES, np.stack([tangents, keys, tangents], 1), "CUBICSPLINE")
    np.testing.assert_allclose(channel.at(time), CubicHermiteSpline(TIMES, keys, tangents)(time), atol=1e-12)


def test_steps_hold_until_the_next_time():
    channel = Channel(0, "scale", TIMES, np.arange(12.0).reshape(4, 1, 3), "STEP")
    for time, row in ((0.0, 0), (0.2, 0), (0.49, 0), (0.5, 1), (1.99, 2), (9.0, 3)):
        np.testing.assert_array_equal(channel.at(time), np.arange(12.0).reshape(4, 3)[row])


def test_a_clip_moves_its_joints_and_leaves_the_others():
    rest = arm().rest
    channels = (
        Channel(1, "rotation", TIMES, QUATS[:, None], "LINEAR"),
        Channel(2, "translation", TIMES[:1], np.ones((1, 1, 3)), "LINEAR"),
    )
    clip = Clip("both", channels)
    pose = clip.pose(rest, 0.5)
    assert clip.seconds == 2.0
    np.testing.assert_allclose(pose.quats[1], QUATS[1], atol=1e-6)
    np.testing.assert_array_equal(pose.translations[2], jnp.ones(3))
    np.testing.assert_array_equal(pose.quats[0], rest.quats[0])
    np.testing.assert_array_equal(pose.scales, rest.scales)
