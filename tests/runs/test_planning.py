"""Short budgets make photos smaller, if that helps."""

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


@pytest.mark.parametrize(("load", "left"), [(0.5, 100 - 5), (4.0, 100 - 2 * 5), (80.0, 50), (None, 100 - 5)])
def test_results_get_more_time_on_a_busy_machine(monkeypatch, load, left):
    def average():
        if load is None:
            raise OSError
        return load, load, load

    monkeypatch.setattr("os.getloadavg", average)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setattr(planning, "SCORING", 0.0)
    monkeypatch.setattr("time.monotonic", lambda: 1000.0)
    assert planning.Deadline(1100.0).left(sized(100, 80)) == pytest.approx(left)
