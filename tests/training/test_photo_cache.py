"""Photos are kept while there is room, and the order and contents of batches do not depend on it."""

import time
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import islice

import jax
import numpy as np
import pytest

from splatax.errors import DatasetError
from splatax.training.devices import Sharding, devices_for
from splatax.training.feed import batches
from splatax.training.groups import steps_of
from splatax.training.photo_cache import PhotoCache
from splatax.training.recipes import Recipe, with_views
from splatax.training.resolution import Resolution
from training.test_training import SIZE, capture

BYTES = 3 * SIZE[0] * SIZE[1]


def counted(views):
    """The views, and how often each has been decoded."""
    times = Counter()

    def counting(view):
        def pixels():
            times[view.name] += 1
            return view.pixels()

        return replace(view, pixels=pixels)

    return tuple(counting(view) for view in views), times


@pytest.mark.parametrize(("photos", "kept"), [(0, 0), (1.5, 1), (100, 100)])
def test_photos_that_fit_are_decoded_once_and_the_others_each_time(photos, kept):
    views, times = counted(capture().train)
    cache = PhotoCache(views, room=photos * BYTES)
    for _ in range(3):
        for index in range(len(views)):
            cache.frame(index, 1)
    assert sorted(times.values()) == sorted([1] * min(kept, len(views)) + [3] * max(len(views) - kept, 0))


def test_photos_of_a_size_that_is_wanted_no_more_make_room():
    views = capture().train
    cache = PhotoCache(views, room=3 * views[0].camera.width * views[0].camera.height)
    small = cache.frame(0, 2)
    assert cache.frame(0, 2) is small
    whole = cache.frame(0, 1)
    assert cache.frame(0, 1) is whole  # there is room for it alone


@pytest.mark.parametrize("resolution", [Resolution(), Resolution(((4, 2),))])
def test_batches_are_the_same_with_and_without_room(resolution):
    views = capture().train
    with_room = islice(batches(views, 3, 0, resolution), 12)
    without = islice(batches(views, 3, 0, resolution, PhotoCache(views, 0)), 12)
    for one, other in zip(with_room, without, strict=True):
        for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(first, second)


class Lengthened(Resolution):
    """Half size until a step that was not known when the photos were read ahead."""

    last = 4

    def divisor(self, step, size):
        return 2 if step <= self.last else 1


def test_photos_that_were_read_ahead_at_another_size_are_read_again():
    resolution = Lengthened()
    sizes = []
    for i, batch in enumerate(islice(batches(capture().train, 3, 0, resolution), 12)):
        sizes.append(batch.divisor)
        assert batch.photo.shape[1] == SIZE[0] // batch.divisor == batch.camera.width
        if i == 2:
            object.__setattr__(resolution, "last", 8)
    assert sizes == [2] * 8 + [1] * 4


def test_slow_photos_come_in_their_order():
    def slow(i, view):
        def pixels():
            time.sleep(0.02 * (i % 3))
            return view.pixels()

        return replace(view, pixels=pixels)

    views = capture().train
    plain = islice(batches(views, 3), 12)
    late_views = [slow(*each) for each in enumerate(views)]
    late = islice(batches(late_views, 3, photos=PhotoCache(late_views, 0)), 12)
    for one, other in zip(plain, late, strict=True):
        assert one.source.view == other.source.view
        np.testing.assert_array_equal(one.photo, other.photo)


def test_a_photo_that_cannot_be_read_ends_the_run_with_its_name():
    def broken():
        raise DatasetError("photo 2: damaged")

    views = capture().train
    views = (*views[:-1], replace(views[-1], pixels=broken))
    with pytest.raises(DatasetError, match="photo 2: damaged"):
        list(islice(batches(views, 0), len(views)))


@dataclass(eq=False)
class Changing:
    """A schedule whose divisor is changed from outside, as that of a run whose number of steps changes."""

    now: int
    asked: set = field(default_factory=set)
    divisors = (1, 2)

    def divisor(self, step, size):
        self.asked.add(step)
        return self.now


def test_views_of_a_step_that_were_read_ahead_at_another_size_are_read_again():
    views, schedule = capture().train, Changing(2)
    recipe = with_views(Recipe(), 2)
    feed = steps_of(views, recipe, 0, schedule, Sharding(devices_for(2, jax.devices()[:1])))
    assert next(feed).divisor == 2
    while 2 not in schedule.asked:  # the next step is read ahead
        time.sleep(0.001)
    schedule.now = 1
    found = next(feed)
    assert found.divisor == 1
    assert found.photo.shape[1:3] == SIZE[::-1]
    feed.close()
