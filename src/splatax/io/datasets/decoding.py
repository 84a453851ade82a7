"""The decoders of photos and masks of views: each knows what its result depends on."""

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

import splatax
from splatax.dataset import Mask, Pixels
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets.undistortion import Straightening
from splatax.io.memory import decoding
from splatax.resampling import resize, resize_mask

AS_STORED = 11  # bytes for a pixel of a photo while it is decoded
RESAMPLED, INTERPOLATED = 50, 30  # while it is undistorted by cubic splines, and by bilinear interpolation


@dataclass(frozen=True)
class Stored:
    """A picture on disk and its way to the size of a view.

    Attributes:
        path: path of the picture.
        decoded: width and height at which it is decoded.
        straighten: how it is undistorted at that size.
        size: width and height of the view.
    """

    path: Path
    decoded: tuple[int, int]
    straighten: Straightening
    size: tuple[int, int]

    @property
    def memory(self) -> int:
        """Bytes that decoding takes."""
        full, straighten = self.decoded[0] * self.decoded[1], self.straighten
        if straighten.resample is None:
            return AS_STORED * full
        if straighten.shrunk is None or straighten.sampled is None:
            return RESAMPLED * full
        largest = max(width * height for width, height in (straighten.shrunk, straighten.sampled))
        return AS_STORED * full + INTERPOLATED * largest

    def identity(self, *more: object) -> str:
        """Returns a key of the result: path, size and date of the file, and all that is done to it.

        Raises:
            OSError: if there is no such file.
        """
        path = self.path.resolve()
        found = path.stat()
        parts = (path, found.st_size, found.st_mtime_ns, self.decoded, self.straighten.described, self.size)
        text = "\0".join(str(part) for part in (*parts, *more, libraries()))
        return hashlib.sha256(text.encode("utf8", "surrogateescape")).hexdigest()


@dataclass(frozen=True)
class PhotoDecoder:
    """Decodes the photo of a view, undistorts and resizes it.

    Attributes:
        stored: the photo on disk.
        upright: true if its EXIF orientation is applied.
        divisor: factor by which decoding shrinks it.
    """

    stored: Stored
    upright: bool
    divisor: int

    def __call__(self) -> Pixels:
        """Returns the photo of the view. It waits while other threads take all memory for decoding."""
        stored = self.stored
        with decoding.taken(stored.memory):
            if stored.straighten.resample is None:
                return images.read(stored.path, upright=self.upright, divisor=self.divisor, size=stored.size)
            pixels = images.read(
                stored.path, upright=self.upright, divisor=self.divisor, size=stored.straighten.shrunk
            )
            with blamed_on(
                stored.path, "the photo cannot be undistorted", "Calibrate its camera again.", DatasetError
            ):
                return resize(stored.straighten(pixels), *stored.size)

    @property
    def identity(self) -> str:
        """Key of the result; see `Stored.identity`."""
        return self.stored.identity("photo", "drafts", self.upright, self.divisor)


@dataclass(frozen=True)
class MaskDecoder:
    """Decodes the mask of a view, and undistorts and resizes it like its photo."""

    stored: Stored

    def __call__(self) -> Mask:
        """Returns the mask of the view. It waits while other threads take all memory for decoding."""
        stored = self.stored
        with decoding.taken(stored.memory):
            mask = resize_mask(images.read_mask(stored.path), *stored.decoded)
            if stored.straighten.resample is None:
                return resize_mask(mask, *stored.size)
            shades = np.repeat(np.where(mask, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
            if stored.straighten.shrunk:
                shades = resize(shades, *stored.straighten.shrunk)
            return resize_mask(stored.straighten(shades)[..., 0] > 127, *stored.size)

    @property
    def identity(self) -> str:
        """Key of the result; see `Stored.identity`."""
        return self.stored.identity("mask")


@cache
def libraries() -> str:
    """Returns the versions of the packages that decode and resample photos."""
    others = (f"{name} {version(name)}" for name in ("pillow", "pycolmap", "scipy"))
    return " ".join((f"splatax {splatax.__version__}", *others))
