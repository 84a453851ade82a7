"""Photos and masks that are resized."""

import numpy as np
from numpy.testing import assert_array_equal
from scipy.ndimage import map_coordinates

from splatax.resampling import ALL, interpolated, places_at, resize, resize_mask


def test_new_pixels_are_means_of_what_they_cover():
    photo = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    means = photo.reshape(2, 2, 3, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resize(photo, 3, 2), means, atol=0.5)  # rounded to whole levels


def test_what_is_transparent_lends_no_colour():
    photo = np.uint8([[[200, 100, 0, 255], [9, 9, 9, 0]]])
    assert resize(photo, 1, 1).tolist() == [[[200, 100, 0, 128]]]
    assert resize(np.uint8([[[9, 9, 9, 0]] * 2]), 1, 1).tolist() == [[[0, 0, 0, 0]]]


def test_a_photo_of_that_size_stays_as_it_is():
    photo = np.random.default_rng(0).integers(0, 255, (3, 5, 4)).astype(np.uint8)
    assert_array_equal(resize(photo, 5, 3), photo)
    assert_array_equal(resize_mask(photo[..., 0] > 9, 5, 3, above=ALL), photo[..., 0] > 9)


def test_a_pixel_counts_if_more_than_half_of_its_area_does():
    mask = np.zeros((2, 6), bool)
    mask[0, :3] = mask[1, 2] = True  # half of the first pixel's four, three of the next, none of the last
    assert resize_mask(mask, 3, 1).tolist() == [[False, False, False]]
    mask[0, 3] = True
    assert resize_mask(mask, 3, 1).tolist() == [[False, True, False]]


def test_a_pixel_counts_only_where_all_of_its_area_does_if_that_is_asked_for():
    mask = np.ones((6, 9), bool)
    mask[0, 0] = False  # one of nine
    assert resize_mask(mask, 3, 2, above=ALL).tolist() == [[False, True, True], [True] * 3]
    assert resize_mask(mask, 3, 2).all()


def test_places_between_pixels_are_means_of_those_around_them():
    photo = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8)
    y, x = np.mgrid[:5, :7].astype(np.float32)
    assert np.abs(interpolated(photo, places_at(y, x, (7, 5))).astype(int) - photo).max() <= 1
    rng = np.random.default_rng(1)
    rows, columns = rng.uniform(0, 4, (6, 9)), rng.uniform(0, 6, (6, 9))
    channels = photo.transpose(2, 0, 1)
    expected = [map_coordinates(channel, (rows, columns), float, order=1) for channel in channels]
    # Places are rounded to 1/256 of a pixel, and levels twice.
    found = interpolated(photo, places_at(rows, columns, (7, 5)))
    np.testing.assert_allclose(found, np.stack(expected, axis=2), atol=2.5)


def test_places_outside_of_a_photo_are_at_its_edge():
    photo = np.random.default_rng(0).integers(0, 255, (4, 5, 3)).astype(np.uint8)
    rows, columns = np.array([[-3.0, 9.0, np.nan]]), np.array([[-2.0, 9.0, 0.0]])
    found = interpolated(photo, places_at(rows, columns, (5, 4)))
    assert np.abs(found[0].astype(int) - photo[[0, 3, 0], [0, 4, 0]]).max() <= 1


def test_what_is_transparent_lends_no_colour_to_places_between_pixels():
    photo = np.uint8([[[200, 100, 0, 255], [9, 9, 9, 0]], [[200, 100, 0, 255], [9, 9, 9, 0]]])
    (pixel,) = interpolated(photo, places_at(np.array([[0.5]]), np.array([[0.5]]), (2, 2)))[0].tolist()
    np.testing.assert_allclose(pixel, [200, 100, 0, 128], atol=1)
