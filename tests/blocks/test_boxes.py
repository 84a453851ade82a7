"""Boxes divide the ground plane: each point is in exactly one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatax.blocks.boxes import MARGIN, Box, block_of, cut, ground_axes, places_of
from splatax.errors import InputError


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 9), st.integers(10, 200), st.integers(0, 10_000))
def test_every_point_is_in_exactly_one_box_also_points_on_borders(count, points, seed):
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(points, 2)) * [3, 1]
    boxes = cut(places, count)
    borders = np.array([[x, y] for box in boxes for x in (*box.low, *places[0]) for y in (*box.high, 0.3)])
    anywhere = np.concatenate([places, 1e6 * rng.normal(size=(50, 2)), borders[np.isfinite(borders).all(1)]])
    assert np.all(sum(box.contains(anywhere).astype(int) for box in boxes) == 1)
    numbers = block_of(anywhere, boxes)
    assert all(
        boxes[number].contains(place[None])[0] for number, place in zip(numbers, anywhere, strict=True)
    )


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_boxes_hold_equally_many_points(count):
    places = np.random.default_rng(0).normal(size=(7_000, 2)) * [2, 1]
    sizes = [int(box.contains(places).sum()) for box in cut(places, count)]
    assert max(sizes) - min(sizes) <= count


def test_the_low_border_belongs_to_a_box_and_the_high_one_does_not():
    box = Box((0.0, 0.0), (1.0, 1.0))
    assert box.contains(np.array([[0, 0], [0, 1], [1, 0], [0.5, 0.999]])).tolist() == [
        True,
        False,
        False,
        True,
    ]


def test_a_block_trains_a_margin_of_a_tenth_of_its_side():
    places = np.stack(np.meshgrid(np.linspace(0, 10, 101), np.linspace(0, 1, 11)), axis=-1).reshape(-1, 2)
    left, _ = cut(places, 2)
    assert left.high[0] == pytest.approx(5, abs=0.11)
    # 5 % of the points at either end do not decide how wide the box is.
    assert left.margin[0] == pytest.approx(MARGIN * 0.9 * 5, abs=0.05)
    just_outside = np.array([[left.high[0] + 0.9 * left.margin[0], 0.5], [left.high[0] + 0.5, 0.5]])
    assert left.trains(just_outside).tolist() == [True, False]
    assert not left.contains(just_outside).any()


def test_a_margin_is_narrower_where_many_points_lie_beside_a_box():
    rng = np.random.default_rng(2)
    sparse = np.stack([rng.uniform(0, 1, 1_000), rng.uniform(0, 1, 1_000)], axis=1)
    crowd = np.stack([rng.uniform(1, 1.001, 1_000), rng.uniform(0, 1, 1_000)], axis=1)
    places = np.concatenate([sparse, crowd])
    for box in cut(places, 2):
        inside, trained = int(box.contains(places).sum()), int(box.trains(places).sum())
        assert inside < trained <= 1.2 * inside


def test_the_ground_is_level_and_its_first_axis_runs_along_the_scene():
    rng = np.random.default_rng(1)
    up = np.array([0.0, -1, 0])
    along, across = np.array([0.6, 0, 0.8]), np.array([0.8, 0, -0.6])
    points = rng.normal(size=(500, 3)) @ np.stack([5 * along, 1 * across, 9 * up])  # highest of all upwards
    axes = ground_axes(points.astype(np.float32), up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-6)
    np.testing.assert_allclose(axes @ up, 0, atol=1e-6)
    assert abs(axes[0] @ along) > 0.99
    assert np.ptp(places_of(points, axes)[:, 0]) > np.ptp(places_of(points, axes)[:, 1])


def test_points_in_one_place_cannot_be_cut():
    with pytest.raises(InputError, match=r"cannot be cut into 2 blocks\. Ask for fewer"):
        cut(np.zeros((5, 2)), 2)
