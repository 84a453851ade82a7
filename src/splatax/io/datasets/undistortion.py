"""Undistorts photos: resamples them as photos of pinhole cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.dataset import Pixels

if TYPE_CHECKING:
    import pycolmap

ROWS = 64  # rows of pixels whose sources are computed at a time
ENOUGH_SHRINKING = 2.0  # factor from which shrinking averages away the blur of bilinear interpolation


@dataclass(frozen=True)
class Straightening:
    """The way in which the photos of a camera are undistorted.

    Attributes:
        resample: undistorts a photo; None leaves photos as they are.
        described: camera, pinhole camera and interpolation in words, on which the result depends.
    """

    resample: Callable[[Pixels], Pixels] | None = None
    described: str = ""

    def __call__(self, pixels: Pixels) -> Pixels:
        """Returns a photo without distortion."""
        return self.resample(pixels) if self.resample else pixels


def undistortion(camera: "pycolmap.Camera", shrinking: float) -> "tuple[pycolmap.Camera, Straightening]":
    """Returns a pinhole camera for the photos of a camera, and how its photos are undistorted.

    Args:
        camera: camera of the photos.
        shrinking: factor by which the result will be shrunk. Bilinear interpolation is fast, but removes half
            of a photo's finest detail (variance of its Laplacian). Photos that keep their size are therefore
            interpolated by cubic splines.
    """
    import pycolmap

    if is_pinhole(camera):
        return camera, Straightening()
    options = pycolmap.UndistortCameraOptions()
    pinhole = pycolmap.undistort_camera(options, camera)
    if shrinking >= ENOUGH_SHRINKING:
        words = f"bilinear {described(camera)} {described(pinhole)}"
        return pinhole, Straightening(partial(bilinear, camera, options), words)
    words = f"cubic {described(camera)} {described(pinhole)}"
    return pinhole, Straightening(partial(cubic, described(camera), described(pinhole)), words)


def is_pinhole(camera: "pycolmap.Camera") -> bool:
    """Returns whether a camera has no distortion, or coefficients that are all zero."""
    # pycolmap calls every camera that is not a fisheye a "perspective pinhole", even with distortion.
    return camera.is_perspective_pinhole() and camera.is_undistorted()


def bilinear(camera: "pycolmap.Camera", options: "pycolmap.UndistortCameraOptions", pixels: Pixels) -> Pixels:
    """Undistorts a photo by bilinear interpolation."""
    import pycolmap

    parts = [pixels[..., :3], *([pixels[..., 3]] if pixels.shape[2] == 4 else [])]
    bitmaps = [pycolmap.Bitmap.from_array(np.ascontiguousarray(part)) for part in parts]
    return np.dstack([pycolmap.undistort_image(options, bitmap, camera)[0].to_array() for bitmap in bitmaps])


Described = tuple[str, int, int, tuple[float, ...]]  # hashable camera: model, width, height, parameters


def described(camera: "pycolmap.Camera") -> Described:
    """Returns a hashable description of a camera."""
    return camera.model.name, camera.width, camera.height, tuple(camera.params.tolist())


def cubic(camera: Described, pinhole: Described, pixels: Pixels) -> Pixels:
    """Undistorts a photo by cubic splines."""
    from scipy import ndimage

    rows_and_columns = sources(camera, pinhole)
    channels = np.empty((*rows_and_columns.shape[1:], pixels.shape[2]), np.uint8)
    for i, channel in enumerate(np.moveaxis(pixels, 2, 0)):
        found = ndimage.map_coordinates(channel, rows_and_columns, np.float32, order=3, mode="nearest")
        channels[..., i] = np.clip(np.round(found, out=found), 0, 255, out=found)
    return channels


@lru_cache(maxsize=2)  # photos of one camera follow each other
def sources(camera: Described, pinhole: Described) -> Float[np.ndarray, "2 h w"]:
    """Returns the row and column in the distorted photo from which each pixel of the pinhole's photo comes.

    Coordinates are relative to the centre of the first pixel.
    """
    import pycolmap

    bent, straight = (
        pycolmap.Camera(model=model, width=width, height=height, params=list(parameters))
        for model, width, height, parameters in (camera, pinhole)
    )
    found = np.empty((2, straight.height, straight.width), np.float32)
    columns = np.arange(straight.width) + 0.5
    for top in range(0, straight.height, ROWS):
        rows = np.arange(top, min(top + ROWS, straight.height)) + 0.5
        places = np.stack([each.ravel() for each in np.meshgrid(columns, rows)], axis=1)
        slopes = np.asarray(straight.cam_from_img(places))
        seen = np.asarray(bent.img_from_cam(np.column_stack([slopes, np.ones(len(slopes))])))
        # COLMAP's origin is the photo's corner, so pixel centres are at halves.
        found[:, top : top + ROWS] = (seen - 0.5).T[::-1].reshape(2, len(rows), straight.width)
    return found
