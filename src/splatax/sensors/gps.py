"""The scale of a scene from the GPS positions of its photos."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera, rig
from splatax.errors import InputError
from splatax.io.gps import Fix, east_north_up
from splatax.math.procrustes import robustly_aligned

ERROR = 5.0  # metres, of a phone under open sky (GPS.gov: 4.9 m), for photos that state none
LEAST_PLACES = 4  # different positions
MOST_UNCERTAIN = 0.1  # relative standard error of the scale up to which it is accepted
SAME = 1e-7  # degrees up to which two positions are the same, about 1 cm


@dataclass(frozen=True)
class GpsScale:
    """The scale of a scene by GPS, and how well it is known.

    Attributes:
        metres_per_unit: metres of one unit of the scene.
        uncertainty: relative standard error of the scale. It assumes that the errors of different positions
            are independent.
        residual: root mean square distance of the cameras from their GPS positions after the fit, metres.
        spread: root mean square distance of the cameras from their middle, metres.
        error: expected error of a position, as the photos or the caller state it, metres.
        used: number of photos in the fit.
        places: number of different GPS positions among them.
        level: true if altitudes were not used, because some photos have none.
        wrong: names of the photos whose position does not agree with the others.
    """

    metres_per_unit: float
    uncertainty: float
    residual: float
    spread: float
    error: float
    used: int
    places: int
    level: bool
    wrong: tuple[str, ...]


def scale_by_gps(
    cameras: Mapping[str, Camera], fixes: Mapping[str, Fix], error: float | None = None
) -> GpsScale:
    """Fits camera positions to GPS positions by a similarity transform, and returns its scale.

    Altitudes are used if all photos have one. Otherwise the fit is that of the plan, seen along the direction
    that points up if the photos were held level (`rig.up_of`). Positions that do not agree with the others
    are left out.

    Args:
        cameras: cameras by the names of their photos.
        fixes: GPS positions by the names of the photos; other names are ignored.
        error: expected error of a position, metres. By default the median of those that the photos state,
            and `ERROR` if they state none.

    Raises:
        InputError: if too few photos have a position, or the positions are too close together for their
            error, so that the scale would be uncertain by more than 10 %.
    """
    names = [name for name in cameras if name in fixes]
    found = [fixes[name] for name in names]
    if (places := _places(found)) < LEAST_PLACES:
        raise InputError(
            f"{len(found)} of {len(cameras)} photos have a GPS position in EXIF, at {places} different "
            f"places, and {LEAST_PLACES} are needed. Programs that shrink or undistort photos often drop "
            "EXIF: use the photos of the camera. Or measure a distance in the scene."
        )
    stated = [fix.error for fix in found if fix.error is not None]
    expected = error if error is not None else float(np.median(stated)) if stated else ERROR
    level = any(fix.altitude is None for fix in found)
    targets, positions = east_north_up(found), rig.positions_of([cameras[name] for name in names])
    if level:
        targets, positions = targets[:, :2], positions @ _plan(list(cameras.values())).T
    alignment, agree = robustly_aligned(positions, targets, expected)
    used, distances = int(agree.sum()), alignment.distances(positions, targets)[agree]
    unknowns = 4 if level else 7
    freedom = max(targets[agree].size - unknowns, 1) / targets[agree].size
    residual = float(np.sqrt(np.mean(distances**2) / freedom))
    apart = positions[agree] - positions[agree].mean(axis=0)
    spread = alignment.scale * float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))
    distinct = _places([fix for fix, kept in zip(found, agree, strict=True) if kept])
    off = max(expected, residual)
    uncertainty = off / (spread * np.sqrt(distinct)) if spread > 0 else np.inf
    if not uncertainty <= MOST_UNCERTAIN or distinct < LEAST_PLACES:
        raise InputError(
            f"the GPS positions are too close together: the cameras are {spread:.3g} m from their middle, at "
            f"{distinct} places that agree, and each is off by about {off:.3g} m. The scale would be "
            f"uncertain by {100 * uncertainty:.0f} %, and at most {100 * MOST_UNCERTAIN:.0f} % is accepted. "
            "Measure a distance in the scene instead, or state the error of your receiver if it is smaller.",
            options=("gps_error",),
        )
    wrong = tuple(name for name, kept in zip(names, agree, strict=True) if not kept)
    known = (alignment.scale, float(uncertainty), float(np.sqrt(np.mean(distances**2))), spread)
    return GpsScale(*known, expected, used, distinct, level, wrong)


def _places(fixes: list[Fix]) -> int:
    """Returns the number of different positions."""
    return len({(round(fix.latitude / SAME), round(fix.longitude / SAME)) for fix in fixes})


def _plan(cameras: list[Camera]) -> Float[np.ndarray, "2 3"]:
    """Returns two axes across the direction up, counterclockwise seen from above, as east and north are."""
    up = rig.up_of(cameras)
    first = np.linalg.svd(up[None])[2][1]
    return np.stack([first, np.cross(up, first)])
