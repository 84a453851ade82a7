"""Short budgets make photos smaller, as far as that helps."""

from dataclasses import replace

import pytest

from splatax.cli import planning
from training.test_training import capture

FULL = (4000, 3000)


def sized(width, height):
    dataset = capture()
    camera = replace(dataset.train[0].camera, width=width, height=height)
    return replace(dataset, train=(replace(dataset.train[0], camera=camera),))


@pytest.fixture(autouse=True)
def large_photos(monkeypatch):
    monkeypatch.setattr(planning, "load_scene", lambda _, k: sized(FULL[0] // k, FULL[1] // k))


@pytest.mark.parametrize(("steps", "divisor"), [(400, 3), (150, 5), (10, 6)])
def test_photos_shrink_until_there_are_enough_steps_but_not_below_a_picture(steps, divisor, tmp_path):
    found, smaller = planning.shrunk(tmp_path, sized(1600, 1200), steps)
    assert found == divisor
    assert smaller.train[0].camera.width == FULL[0] // divisor


def test_photos_keep_their_size_where_there_are_steps_enough(tmp_path):
    assert planning.shrunk(tmp_path, sized(1600, 1200), planning.ENOUGH_STEPS) is None


def test_small_photos_keep_their_size(tmp_path):
    assert planning.shrunk(tmp_path, sized(666, 500), 50) is None
