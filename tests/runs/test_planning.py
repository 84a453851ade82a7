"""Short budgets make photos smaller, as far as that helps."""

from dataclasses import replace

import pytest

from splatax.runs import planning
from training.test_training import capture

FULL = (4000, 3000)


def sized(width, height):
    dataset = capture()
    camera = replace(dataset.train[0].camera, width=width, height=height)
    return replace(dataset, train=(replace(dataset.train[0], camera=camera),))


def divided(k):
    return sized(FULL[0] // k, FULL[1] // k)


@pytest.mark.parametrize(("steps", "divisor"), [(400, 3), (150, 5), (10, 6)])
def test_photos_shrink_until_there_are_enough_steps_but_not_below_a_picture(steps, divisor):
    found, smaller = planning.smaller_photos(divided, sized(1600, 1200), steps)
    assert found == divisor
    assert smaller.train[0].camera.width == FULL[0] // divisor


def test_photos_keep_their_size_where_there_are_steps_enough():
    assert planning.smaller_photos(divided, sized(1600, 1200), planning.ENOUGH_STEPS) is None


def test_small_photos_keep_their_size():
    assert planning.smaller_photos(divided, sized(666, 500), 50) is None
