"""Reads, measures and writes photos and masks.

Only the formats in `FORMATS` are opened, because Pillow has formats that start other programs. Memory is
bounded before anything is decoded. Pillow's own limit is a number of pixels that does not depend on the
machine, and it refuses the photos of phones. Here one photo may take 1 / `MEMORY_DIVISOR` of the memory.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from jaxtyping import UInt8

from splatax.dataset import Mask, Pixels
from splatax.errors import DatasetError
from splatax.io.damage import blamed_on
from splatax.io.files import write_whole
from splatax.io.levels import SIDEWAYS, eight_bits, orientation, turned
from splatax.io.memory import MEMORY_DIVISOR, machine_memory
from splatax.resampling import resize

if TYPE_CHECKING:
    from PIL import Image

SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
FORMATS = ("JPEG", "PNG", "BMP", "TIFF", "WEBP", "HEIF")  # HEIF needs pillow-heif
BYTES_PER_PIXEL = 8  # peak of `read`, measured at 144 megapixels: 4 in Pillow, 3 or 4 in the result
BYTES_OF_FORMAT = {"WEBP": 18, "TIFF": 12, "HEIF": 18}  # bytes per pixel of decoders that hold more copies
BYTES_PER_COEFFICIENT = 2  # progressive JPEG keeps the coefficients of the full size, even for a draft
BOX, HAMMING = 4, 5  # Pillow's filters: the mean of an area, and one whose borders are tapered
DRAFTS = (1, 2, 4, 8)  # divisors of the size at which a JPEG can be decoded
HALF, ENOUGH = 2, 2.5  # the draft for shrinking by so much or more, if that is no whole number

_limit: int | None = None


def limit_memory(limit: int | None) -> None:
    """Sets the number of bytes that decoding one photo may take.

    None is a fixed fraction of the machine's memory. The process shares the limit.
    """
    global _limit
    _limit = limit


def memory_limit() -> int:
    """Returns the number of bytes that decoding one photo may take."""
    return machine_memory() // MEMORY_DIVISOR if _limit is None else _limit


def is_image(path: Path) -> bool:
    """Returns whether a path has the suffix of a photo and is not hidden."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


@dataclass(frozen=True)
class Header:
    """Properties of a photo that its header tells, before the photo is decoded.

    Attributes:
        size: width and height after decoding, pixels.
        divisor: factor by which decoding shrinks the photo to fit into memory: 1, 2, 4 or 8.
    """

    size: tuple[int, int]
    divisor: int = 1


def header_of(path: Path, *, upright: bool = False, what: str = "photo") -> Header:
    """Returns the size of a photo from its header alone.

    Args:
        path: path of the photo.
        upright: apply the EXIF orientation. A PNG may store it behind the pixels, and is then decoded.
        what: noun for the picture in messages.

    Raises:
        DatasetError: if the file is not a photo, is damaged, or would not fit into memory.
    """
    with opened(path, what) as image:
        header = _fitting(path, image)
        if upright and orientation(image) in SIDEWAYS:
            return Header(header.size[::-1], header.divisor)
        return header


def size_of(path: Path, *, upright: bool = False, what: str = "photo") -> tuple[int, int]:
    """Returns the width and height to which `read` decodes a photo; see `header_of`."""
    return header_of(path, upright=upright, what=what).size


def read(
    path: Path, *, upright: bool = False, divisor: int | None = None, size: tuple[int, int] | None = None
) -> Pixels:
    """Decodes a photo to 8-bit RGB, or RGBA where it has an alpha channel.

    Photos of 10 to 16 bits are scaled to 8.

    Args:
        path: path of the photo.
        upright: apply the EXIF orientation.
        divisor: factor by which the photo is decoded smaller, from `header_of`. None computes it.
        size: width and height to resize the decoded photo to; see `resampling.resize`. None keeps its size.

    Raises:
        DatasetError: if the file is not a photo, is damaged, has no 8-bit equivalent, or would not fit into
            memory.
    """
    with opened(path) as image:
        header = _fitting(path, image) if divisor is None else Header(_divided(image.size, divisor), divisor)
        if header.divisor > 1:
            image.draft(None, header.size)
        way_up = orientation(image) if upright else 1
        if size and way_up == 1 and image.mode == "RGB" and not image.has_transparency_data:
            return _shrunk(path, image, header, size)
        pixels = np.ascontiguousarray(turned(eight_bits(path, image), way_up))
    return resize(pixels, *size) if size else pixels


def _shrunk(path: Path, image: "Image.Image", header: Header, size: tuple[int, int]) -> Pixels:
    """Returns an opened RGB photo at a size, by means over areas; a JPEG is not decoded larger than needed.

    At factors that are no whole numbers, a draft of half the size and a tapered filter are nearer to the
    exact means (43 to 48 dB in a photo of 12 megapixels) than Pillow's BOX filter on all of it (40 to 44 dB).
    """
    factors = [side / new for side, new in zip(header.size, size, strict=True)]
    part = drafted(factors) if image.format in ("JPEG", "MPO") and header.divisor == 1 else 1
    if part > 1:
        image.draft(None, _divided(header.size, part))
    image.load()  # resizing Pillow's own pixels saves two copies of the photo
    if image.size == size:
        return eight_bits(path, image)
    width, height = (side / part for side in header.size)  # the draft is rounded up
    filtering = BOX if part == 1 or _whole(factors[0] / part) else HAMMING
    return np.array(image.resize(size, filtering, (0, 0, width, height)))


def drafted(factors: Sequence[float]) -> int:
    """Returns the divisor of the size at which a JPEG that is shrunk by these factors is decoded."""
    factor = min(factors)
    if all(map(_whole, factors)):
        return max(divisor for divisor in DRAFTS if all(round(each) % divisor == 0 for each in factors))
    return HALF if factor >= ENOUGH else 1


def _whole(factor: float) -> bool:
    return abs(factor - round(factor)) < 1e-6


def glance(path: Path, side: int) -> Pixels:
    """Decodes a photo to a small size, with no side longer than `side` pixels.

    A JPEG is not decoded at its full size.

    Raises:
        DatasetError: in the cases that `read` lists.
    """
    from PIL import Image

    with opened(path) as image:
        image.draft("RGB", (side, side))
        _fitting(path, image)
        small = Image.fromarray(eight_bits(path, image))
        small.thumbnail((side, side), Image.Resampling.BOX)
        return np.array(small)


def read_mask(path: Path) -> Mask:
    """Decodes a mask, which is true wherever the picture is not black.

    Raises:
        DatasetError: if the file is not a picture, is damaged, or would not fit into memory.
    """
    with opened(path, "mask") as image:
        _fitting(path, image)
        one_channel = image.mode in ("1", "L", "I", "F") or image.mode.startswith("I;16")
        shades = np.atleast_3d(np.array(image if one_channel else image.convert("RGB")))
        return np.any(shades != 0, axis=2)


def write(path: Path, pixels: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 4"]) -> None:
    """Writes a PNG atomically: a crash leaves the old file unchanged."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_whole(path, buffer.getvalue())


@contextmanager
def opened(path: Path, what: str = "photo", way_out: str | None = None) -> Iterator["Image.Image"]:
    """Opens a picture of a known format without decoding it. Exceptions inside become errors about it.

    Args:
        path: path of the picture.
        what: noun for the picture in messages.
        way_out: end of the message about a damaged picture. None: to restore a photo, and to make another
            picture again.

    Raises:
        DatasetError: if there is no such picture, or it is damaged.
    """
    way_out = way_out or ("Restore it from the camera." if what == "photo" else "Make it again.")
    if not path.exists():
        raise DatasetError(f"{path}: no such {what}.")
    with path.open("rb") as file:
        with blamed_on(path, f"not a {what} that can be read", way_out, DatasetError):
            image = _identified(path, file, what, way_out)
        with blamed_on(path, f"the {what} is damaged", way_out, DatasetError), image:
            yield image


def _identified(path: Path, file: BinaryIO, what: str, way_out: str) -> "Image.Image":
    """Opens a picture as `PIL.Image.open` does, without its limit of pixels; see the top of this file."""
    # Importing a plugin registers it.
    from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin

    del BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin
    prefix = file.read(16)
    if not prefix:
        raise DatasetError(f"{path}: an empty file, not a {what}. {way_out}")
    for name in FORMATS:
        factory, accept = Image.OPEN.get(name, (None, None))
        if factory is not None and (accept is None or accept(prefix) is True):
            file.seek(0)
            # If Pillow gets the name, it maps some files into memory. A file that is truncated meanwhile
            # would then kill the process, and an uncompressed TIFF that must be turned would be scrambled.
            return factory(file, "")
    raise DatasetError(
        f"{path}: not a {what} that can be read. {what.capitalize()}s are {', '.join(sorted(SUFFIXES))}: "
        "convert it to one of them."
    )


def _fitting(path: Path, image: "Image.Image") -> Header:
    """Returns the largest size at which an opened photo can be decoded within the memory limit.

    Raises:
        DatasetError: if no size fits.
    """
    limit = memory_limit()
    for divisor in DRAFTS if image.format in ("JPEG", "MPO") else (1,):
        size = _divided(image.size, divisor)
        if (needed := _memory(image, size)) <= limit:
            return Header(size, divisor)
    width, height = image.size
    raise DatasetError(
        f"{path}: decoding its {width} x {height} pixels takes {needed / 1e9:.1f} GB, and "
        f"{limit / 1e9:.1f} GB may be used for one photo here. Shrink it, or save it as JPEG, which can be "
        "read at a smaller size."
    )


def _memory(image: "Image.Image", size: tuple[int, int]) -> int:
    per_pixel = BYTES_OF_FORMAT.get(image.format or "", BYTES_PER_PIXEL)
    kept = 0
    if image.info.get("progressive"):
        kept = BYTES_PER_COEFFICIENT * len(image.getbands()) * image.size[0] * image.size[1]
    return per_pixel * size[0] * size[1] + kept


def _divided(size: tuple[int, int], divisor: int) -> tuple[int, int]:
    """Returns the size of a JPEG that is decoded smaller; it is rounded up."""
    return -(-size[0] // divisor), -(-size[1] // divisor)
