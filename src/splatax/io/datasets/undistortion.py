"""Undistorts photos: resamples them as photos of pinhole cameras.

A photo that will be much smaller is shrunk first, and resampled at the smaller size. This takes a fraction of
the time, and a JPEG need not be decoded at its full size.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.dataset import Pixels
from splatax.resampling import Places, interpolated, places_at

if TYPE_CHECKING:
    import pycolmap

ROWS = 64  # rows of pixels whose sources are computed at a time
ENOUGH_SHRINKING = 2.0  # factor from which shrinking averages away the blur of bilinear interpolation
# Bilinear interpolation is a mean over 2 x 2 pixels, weighted by a pyramid. If about 1.5 of these pixels make
# one of the view, that is the mean over the area of the view's pixel. Less is blurred, more is aliased.
LEAST_DETAIL, MOST_DETAIL = 1.25, 1.75
NODES = 8  # pixels from one to the next that the lens model is evaluated for; between them, places are linear

Size = tuple[int, int]  # width, height, pixels
Described = tuple[str, int, int, tuple[float, ...]]  # hashable camera: model, width, height, parameters


@dataclass(frozen=True)
class Straightening:
    """The way in which the photos of a camera are undistorted.

    Attributes:
        resample: undistorts a photo; None leaves photos as they are.
        described: camera, pinhole camera and interpolation in words, on which the result depends.
        shrunk: width and height that photos are shrunk to before; None for those at which they are decoded.
        sampled: width and height of the result; None for those of the pinhole camera.
    """

    resample: Callable[[Pixels], Pixels] | None = None
    described: str = ""
    shrunk: Size | None = None
    sampled: Size | None = None

    def __call__(self, pixels: Pixels) -> Pixels:
        """Returns a photo without distortion."""
        return self.resample(pixels) if self.resample else pixels


def undistortion(camera: "pycolmap.Camera", shrinking: float) -> "tuple[pycolmap.Camera, Straightening]":
    """Returns a pinhole camera for the photos of a camera, and how its photos are undistorted.

    Args:
        camera: camera of the photos.
        shrinking: factor by which the result will be smaller than a photo. Photos that are shrunk by 2 or
            more are shrunk first, and interpolated bilinearly, which is fast, at about 1.5 times the size of
            the result. At their own size that would remove half of a photo's finest detail (variance of its
            Laplacian). Photos that keep their size are therefore interpolated by cubic splines.
    """
    import pycolmap

    if is_pinhole(camera):
        return camera, Straightening()
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    lenses = described(camera), described(pinhole)
    if shrinking < ENOUGH_SHRINKING:
        return pinhole, Straightening(partial(cubic, *lenses), f"cubic {lenses}")
    size, sampled = sizes(camera, pinhole, shrinking)
    words = f"bilinear {size} {sampled} {lenses}"
    return pinhole, Straightening(partial(bilinear, *lenses, sampled), words, size, sampled)


def undistortion_of_files(
    camera: "pycolmap.Camera", shrinking: float
) -> "tuple[pycolmap.Camera, Straightening]":
    """Returns a pinhole camera for the photos of a camera, and how they are undistorted at their own size.

    Args:
        camera: camera of the photos.
        shrinking: factor by which the files will be shrunk when they are loaded. From 2 on they are
            interpolated bilinearly, which is fast.
    """
    pinhole, straighten = undistortion(camera, shrinking)
    if straighten.sampled is None:
        return pinhole, straighten
    size = pinhole.width, pinhole.height
    words = f"bilinear {size} {described(camera)} {described(pinhole)}"
    return pinhole, Straightening(partial(bilinear, described(camera), described(pinhole), size), words)


def sizes(camera: "pycolmap.Camera", pinhole: "pycolmap.Camera", shrinking: float) -> tuple[Size, Size]:
    """Returns the size that a photo is shrunk to, and that at which it is interpolated.

    The first is the photo's own, or a half, a quarter, ... of it, at which a JPEG can be decoded. The second
    is that of the view, or twice as much where the view would otherwise leave out pixels.
    """
    divisor = 1
    while shrinking / divisor >= 2 * LEAST_DETAIL:
        divisor *= 2
    finer = 1 if shrinking / divisor <= MOST_DETAIL else 2

    def divided(lens: "pycolmap.Camera", factor: float | int, least: int = 1) -> Size:
        return max(least, round(lens.width / factor)), max(least, round(lens.height / factor))

    width, height = divided(pinhole, shrinking)
    return divided(camera, divisor, 2), (finer * width, finer * height)


def is_pinhole(camera: "pycolmap.Camera") -> bool:
    """Returns whether a camera has no distortion, or coefficients that are all zero."""
    # pycolmap calls every camera that is not a fisheye a "perspective pinhole", even with distortion.
    return camera.is_perspective_pinhole() and camera.is_undistorted()


def described(camera: "pycolmap.Camera") -> Described:
    """Returns a hashable description of a camera."""
    return camera.model.name, camera.width, camera.height, tuple(camera.params.tolist())


def bilinear(camera: Described, pinhole: Described, sampled: Size, pixels: Pixels) -> Pixels:
    """Undistorts a photo by bilinear interpolation, to any size.

    Args:
        camera: camera of the photo, perhaps at another size than the photo's.
        pinhole: camera of the result, perhaps at another size.
        sampled: width and height of the result, pixels.
        pixels: the photo.
    """
    height, width = pixels.shape[:2]
    return interpolated(pixels, places_of(camera, pinhole, (width, height), sampled))


@lru_cache(maxsize=2)  # photos of one camera follow each other
def places_of(camera: Described, pinhole: Described, size: Size, sampled: Size) -> Places:
    """Returns the places in a photo of some size that the pixels of a pinhole's photo of some size show.

    The lens is evaluated at every `NODES`-th pixel of every `NODES`-th row.
    """
    width, height = sampled
    columns = (np.arange(-(-width // NODES) + 1) * NODES + 0.5) * pinhole[1] / width
    rows = (np.arange(-(-height // NODES) + 1) * NODES + 0.5) * pinhole[2] / height
    nodes = seen_through(camera, pinhole, columns, rows)
    nodes *= np.array([size[1] / camera[2], size[0] / camera[1]])[:, None, None]
    nodes = (nodes - 0.5).astype(np.float32)
    dense = spread(spread(nodes.swapaxes(1, 2), width).swapaxes(1, 2), height)
    return places_at(dense[0], dense[1], size)


def spread(nodes: Float[np.ndarray, "2 n m"], count: int) -> Float[np.ndarray, "2 count m"]:
    """Returns values between rows `NODES` apart, by linear interpolation."""
    parts = (np.arange(NODES, dtype=np.float32) / NODES)[:, None]
    between = nodes[:, :-1, None] + np.diff(nodes, axis=1)[:, :, None] * parts
    return between.reshape(2, -1, nodes.shape[2])[:, :count]


def cubic(camera: Described, pinhole: Described, pixels: Pixels) -> Pixels:
    """Undistorts a photo by cubic splines."""
    from scipy import ndimage

    rows_and_columns = sources(camera, pinhole)
    channels = np.empty((*rows_and_columns.shape[1:], pixels.shape[2]), np.uint8)
    for i, channel in enumerate(np.moveaxis(pixels, 2, 0)):
        found = ndimage.map_coordinates(channel, rows_and_columns, np.float32, order=3, mode="nearest")
        channels[..., i] = np.clip(np.round(found, out=found), 0, 255, out=found)
    return channels


@lru_cache(maxsize=2)
def sources(camera: Described, pinhole: Described) -> Float[np.ndarray, "2 h w"]:
    """Returns the row and column in the distorted photo from which each pixel of the pinhole's photo comes.

    Coordinates are relative to the centre of the first pixel.
    """
    _, width, height, _ = pinhole
    found = np.empty((2, height, width), np.float32)
    columns = np.arange(width) + 0.5
    for top in range(0, height, ROWS):
        rows = np.arange(top, min(top + ROWS, height)) + 0.5
        found[:, top : top + ROWS] = seen_through(camera, pinhole, columns, rows) - 0.5
    return found


def seen_through(
    camera: Described, pinhole: Described, columns: Float[np.ndarray, " w"], rows: Float[np.ndarray, " h"]
) -> Float[np.ndarray, "2 h w"]:
    """Returns the row and column in a distorted photo of what a pinhole's photo shows at each row and column.

    All are pixels from the photo's corner, as COLMAP counts them: pixel centres are at halves.
    """
    import pycolmap

    bent, straight = (
        pycolmap.Camera(model=model, width=width, height=height, params=list(parameters))
        for model, width, height, parameters in (camera, pinhole)
    )
    places = np.stack([each.ravel() for each in np.meshgrid(columns, rows)], axis=1)
    slopes = np.asarray(straight.cam_from_img(places))
    seen = np.asarray(bent.img_from_cam(np.column_stack([slopes, np.ones(len(slopes))])))
    return seen.T[::-1].reshape(2, len(rows), len(columns))
