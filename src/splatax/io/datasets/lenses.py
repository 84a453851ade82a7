"""Lens models of other programs as COLMAP cameras, which `undistortion` can undistort.

With (x, y) = (X, Y) / Z, r^2 = x^2 + y^2 and u = f x' + c, v = f y' + c from the photo's corner:

    perspective   x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)      (y' alike, p1 and
    fisheye       the same of (x, y) atan(r) / r, with k4 r^8                               p2 exchanged)
"""

from typing import TYPE_CHECKING

from splatax.errors import DatasetError, shown

if TYPE_CHECKING:
    import pycolmap

Pair = tuple[float | int, float | int]


def perspective(
    size: Pair,
    focal: Pair,
    centre: Pair,
    radial: tuple[float, ...] = (),
    tangential: Pair = (0.0, 0.0),
) -> "pycolmap.Camera":
    """Returns a camera with polynomial distortion, in OpenCV's convention.

    Args:
        size: width and height, pixels.
        focal: focal lengths along x and y, pixels.
        centre: principal point from the photo's corner, pixels.
        radial: k1, k2 and k3, of which the last may be left out.
        tangential: p1 and p2.
    """
    k1, k2, k3 = (*radial, 0.0, 0.0, 0.0)[:3]
    if k3:
        return camera("FULL_OPENCV", size, [*focal, *centre, k1, k2, *tangential, k3, 0.0, 0.0, 0.0])
    return camera("OPENCV", size, [*focal, *centre, k1, k2, *tangential])


def fisheye(
    size: Pair,
    focal: Pair,
    centre: Pair,
    radial: tuple[float, ...] = (),
    tangential: Pair = (0.0, 0.0),
) -> "pycolmap.Camera":
    """Returns an equidistant fisheye camera; the arguments are those of `perspective`, with k4."""
    k1, k2, k3, k4 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    if any(tangential):
        return camera("THIN_PRISM_FISHEYE", size, [*focal, *centre, k1, k2, *tangential, k3, k4, 0.0, 0.0])
    return camera("OPENCV_FISHEYE", size, [*focal, *centre, k1, k2, k3, k4])


def camera(model: str, size: Pair, parameters: list[float]) -> "pycolmap.Camera":
    """Returns a COLMAP camera."""
    import pycolmap

    return pycolmap.Camera(model=model, width=round(size[0]), height=round(size[1]), params=parameters)


def refused(where: object, model: str) -> DatasetError:
    """Returns the error about a lens model that cannot be undistorted."""
    return DatasetError(
        f"{where}: photos of the lens model {shown(model)} cannot be undistorted here. Export undistorted "
        "photos with their cameras."
    )
