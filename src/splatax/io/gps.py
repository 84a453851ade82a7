"""Positions that photos keep in EXIF, as satellite navigation (GPS) measured them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.io import images

GPS_TABLE = 0x8825  # of EXIF; the numbers below are its tags
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE, ERROR = 1, 2, 3, 4, 5, 6, 31
RADIUS, FLATTENING = 6_378_137.0, 1 / 298.257_223_563  # of the ellipsoid of WGS 84, metres


@dataclass(frozen=True)
class Fix:
    """A position that satellite navigation measured.

    Attributes:
        latitude: degrees north, WGS 84.
        longitude: degrees east, WGS 84.
        altitude: metres; None if it was not measured.
        error: horizontal error that the device states (GPSHPositioningError), metres; None if it states none.
    """

    latitude: float
    longitude: float
    altitude: float | None = None
    error: float | None = None


def fix_of(path: Path) -> Fix | None:
    """Returns the position that a photo keeps in EXIF; None if it keeps none that is possible.

    Latitude and longitude of exactly 0 count as none: cameras without reception write them.

    Raises:
        DatasetError: if the file is not a photo, or is damaged.
    """
    with images.opened(path) as image:
        table = image.getexif().get_ifd(GPS_TABLE)
    latitude = _degrees(table.get(LATITUDE), str(table.get(LATITUDE_REF, "N")), "NS")
    longitude = _degrees(table.get(LONGITUDE), str(table.get(LONGITUDE_REF, "E")), "EW")
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:  # false for NaN
        return None
    altitude, error = _number(table.get(ALTITUDE)), _number(table.get(ERROR))
    below = table.get(ALTITUDE_REF, 0) in (1, b"\1")
    return Fix(
        latitude,
        longitude,
        (-altitude if below else altitude) if np.isfinite(altitude) else None,
        error if 0 < error < np.inf else None,
    )


def _degrees(values: Any, side: str, sides: str) -> float:
    """Returns an angle from degrees, minutes and seconds; NaN if they are none."""
    numbers = [_number(value) for value in values] if isinstance(values, tuple) else []
    if len(numbers) != 3 or side.strip("\0 ").upper() not in tuple(sides):
        return float("nan")
    angle = numbers[0] + numbers[1] / 60 + numbers[2] / 3600
    return -angle if side.strip("\0 ").upper() == sides[1] else angle


def _number(value: Any) -> float:
    """Returns an EXIF value as a number; NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return float("nan")


def east_north_up(fixes: Sequence[Fix]) -> Float[np.ndarray, "n 3"]:
    """Returns positions in local metres: to the east, to the north, and up.

    The origin is one of them, in their midst. A position without an altitude counts as on the ellipsoid.
    """
    angles = np.radians([[fix.latitude, fix.longitude] for fix in fixes])
    (north, east), height = angles.T, np.array([fix.altitude or 0.0 for fix in fixes])
    eccentricity = FLATTENING * (2 - FLATTENING)  # squared
    normal = RADIUS / np.sqrt(1 - eccentricity * np.sin(north) ** 2)
    across = (normal + height) * np.cos(north)
    along = (normal * (1 - eccentricity) + height) * np.sin(north)
    world = np.stack([across * np.cos(east), across * np.sin(east), along], axis=1)
    origin = int(np.argmin(np.linalg.norm(world - np.median(world, axis=0), axis=1)))
    (sin_phi, sin_lam), (cos_phi, cos_lam) = np.sin(angles[origin]), np.cos(angles[origin])
    axes = np.array(
        [
            [-sin_lam, cos_lam, 0],
            [-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi],
            [cos_phi * cos_lam, cos_phi * sin_lam, sin_phi],
        ]
    )
    return (world - world[origin]) @ axes.T
