"""Photos without distortion: a photo that is shrunk first is the one that is undistorted first."""

import numpy as np
import pycolmap
import pytest
from scipy.ndimage import gaussian_filter

from splatax.io.datasets.undistortion import (
    cubic,
    described,
    places_of,
    sources,
    undistortion,
    undistortion_of_files,
)
from splatax.resampling import LEVELS, resize

SIZE = (480, 360)
LENSES = {
    "barrel": ("OPENCV", [340, 340, 240, 180, -0.2, 0.03, 0.003, -0.002]),
    "cushion": ("SIMPLE_RADIAL", [340, 236, 184, 0.15]),
    "fisheye": ("OPENCV_FISHEYE", [260, 260, 240, 180, 0.02, -0.01, 0, 0]),
}


def lens(name):
    model, params = LENSES[name]
    return pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params)


def detailed():
    """A picture with edges, and noise at all scales."""
    rng = np.random.default_rng(0)
    noise = sum(
        12 * scale * gaussian_filter(rng.normal(size=(360, 480, 3)), (scale, scale, 0)) for scale in (1, 3, 9)
    )
    y, x = np.mgrid[:360, :480]
    edges = 40 * np.sign(np.sin(x / 23 + y / 31) + np.sin(y / 17))
    return np.clip(128 + 2 * noise + edges[..., None], 0, 255).astype(np.uint8)


def undistorted_first(photo, camera, pinhole, size):
    return resize(cubic(described(camera), described(pinhole), photo), *size)


def shrunk_first(photo, straighten, size):
    return resize(straighten(resize(photo, *straighten.shrunk)), *size)


def both(photo, name, factor):
    camera = lens(name)
    pinhole, straighten = undistortion(camera, factor)
    size = round(pinhole.width / factor), round(pinhole.height / factor)
    pictures = shrunk_first(photo, straighten, size), undistorted_first(photo, camera, pinhole, size)
    return [picture.astype(np.float64) for picture in pictures]


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("factor", [2.0, 2.4, 3.0, 4.0, 6.0])
def test_a_photo_that_is_shrunk_first_is_the_one_that_is_undistorted_first(name, factor):
    found, expected = both(detailed(), name, factor)
    assert found.shape == expected.shape
    inside = (slice(2, -2), slice(2, -2))  # at the edge a pixel may reach beyond the photo
    error = np.sqrt(np.mean((found - expected)[inside] ** 2))
    shifted = np.sqrt(np.mean((expected[2:-2, 2:-2] - expected[2:-2, 3:-1]) ** 2))
    assert error < 5  # levels, of 255; it is 1 to 4.5
    assert error < shifted / 3  # a shift by a third of a pixel would be more


@pytest.mark.parametrize("factor", [2.0, 2.4, 3.0, 4.0, 6.0])
def test_stripes_that_are_too_fine_for_the_view_become_grey(factor):
    """Leaving out pixels would turn them into coarse stripes of the same contrast."""
    x = np.arange(480) + 0.3 * np.arange(360)[:, None]
    stripes = np.repeat((128 + 100 * np.sin(2 * np.pi * x / 2.6))[..., None], 3, axis=2).astype(np.uint8)
    found, _ = both(stripes, "barrel", factor)
    assert found.std() < 0.3 * stripes.std()


@pytest.mark.parametrize("name", LENSES)
def test_places_between_the_nodes_of_the_lens_are_right(name):
    camera = lens(name)
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    places = places_of(described(camera), described(pinhole), SIZE, (pinhole.width, pinhole.height))
    rows, columns = np.divmod(places.index, SIZE[0])
    found = np.stack([rows + places.below / LEVELS, columns + places.right / LEVELS])
    expected = sources(described(camera), described(pinhole))
    limits = np.array([SIZE[1] - 1, SIZE[0] - 1])[:, None, None]
    # Numbers are rounded to 1/256, and those at the last pixel are one of these parts before it.
    assert np.abs(found - np.clip(expected, 0, limits)).max() < 0.03


@pytest.mark.parametrize("factor", [2.5, 3.0, 3.9])
def test_a_large_photo_is_decoded_at_half_its_size(factor):
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=4000, height=3000, params=[2800, 2000, 1500, -0.1])
    _, straighten = undistortion(camera, factor)
    assert straighten.shrunk == (2000, 1500)


@pytest.mark.parametrize("shrinking", [1.0, 3.0])
def test_undistorted_files_have_the_size_of_the_photo_however_they_will_be_shrunk(shrinking):
    camera, photo = lens("barrel"), detailed()
    pinhole, straighten = undistortion_of_files(camera, shrinking)
    straight = straighten(photo)
    assert straight.shape == (pinhole.height, pinhole.width, 3)
    exact = cubic(described(camera), described(pinhole), photo)
    assert np.abs(straight.astype(float) - exact).mean() < 6
