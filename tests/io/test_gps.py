"""GPS positions in EXIF of photos, and the local metres that they are converted to."""

import pytest
from numpy.testing import assert_allclose
from PIL import Image, TiffImagePlugin

from splatax.io.gps import GPS_TABLE, Fix, east_north_up, fix_of


def photo_with(path, **tags) -> None:
    """Writes a photo whose EXIF has a table of GPS tags, by their numbers."""
    image = Image.new("RGB", (8, 6))
    exif = image.getexif()
    exif[GPS_TABLE] = {int(name.removeprefix("tag")): value for name, value in tags.items()}
    image.save(path, exif=exif)


def ratio(top, bottom=1):
    return TiffImagePlugin.IFDRational(top, bottom)


SOUTH = {"tag1": "S", "tag2": (ratio(33), ratio(51), ratio(3135, 100))}  # the opera house of Sydney
EAST = {"tag3": "E", "tag4": (ratio(151), ratio(12), ratio(5073, 100))}


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_a_position_is_read_with_its_sides_and_its_error(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    photo_with(path, **SOUTH, **EAST, tag5=b"\1", tag6=ratio(45, 10), tag31=ratio(32, 10))
    found = fix_of(path)
    assert_allclose([found.latitude, found.longitude], [-33.858708, 151.214092], atol=1e-6)
    assert (found.altitude, found.error) == (-4.5, 3.2)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        SOUTH,
        {**SOUTH, **EAST, "tag2": (ratio(133), ratio(0), ratio(0))},
        {**SOUTH, **EAST, "tag4": (ratio(0, 0), ratio(0), ratio(0))},
        {"tag1": "N", "tag2": (ratio(0),) * 3, "tag3": "E", "tag4": (ratio(0),) * 3},
        {**SOUTH, **EAST, "tag3": "?"},
    ],
    ids=["nothing", "half", "beyond the pole", "not a number", "no reception", "no side"],
)
def test_positions_that_cannot_be_are_none(tmp_path, tags):
    photo_with(tmp_path / "a.jpg", **tags)
    assert fix_of(tmp_path / "a.jpg") is None


def test_a_position_without_an_altitude_or_error_is_known_without_them(tmp_path):
    photo_with(tmp_path / "a.jpg", **SOUTH, **EAST)
    found = fix_of(tmp_path / "a.jpg")
    assert (found.altitude, found.error) == (None, None)


def test_local_axes_point_to_the_east_to_the_north_and_up():
    # A minute of latitude is 1,843 m at the equator and 1,862 m at the poles; one of longitude is 930 m here.
    here, above = Fix(60.0, 10.0, 100.0), Fix(60.0, 10.0, 130.0)
    north, east = Fix(60 + 1 / 60, 10.0, 100.0), Fix(60.0, 10 + 1 / 60, 100.0)
    places = east_north_up([here, above, north, east])
    places = places - places[0]
    assert_allclose(places[1], [0, 0, 30], atol=1e-6)
    assert_allclose(places[2], [0, 1857.0, 0], atol=1.5)
    assert_allclose(places[3], [930.2, 0, 0], atol=1.5)
