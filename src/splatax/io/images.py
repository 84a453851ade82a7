"""Reads, measures and writes photos and masks.

Only the formats in `FORMATS` are opened, because Pillow has formats that start other programs. Memory is
bounded before anything is decoded. Pillow's own limit is a number of pixels that does not depend on the
machine, and it refuses the photos of phones. Here one photo may take 1 / `MEMORY_SHARE` of the memory.
"""

import io
from collections.abc import Iterator
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
from splatax.io.memory import machine_memory

if TYPE_CHECKING:
    from PIL import Image

SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
FORMATS = ("JPEG", "PNG", "BMP", "TIFF", "WEBP", "HEIF")  # HEIF needs pillow-heif
BYTES_PER_PIXEL = 8  # peak of `read`, measured at 144 megapixels: 4 in Pillow, 3 or 4 in the result
BYTES_OF_FORMAT = {"WEBP": 18, "TIFF": 12, "HEIF": 18}  # bytes per pixel of decoders that hold more copies
BYTES_PER_COEFFICIENT = 2  # progressive JPEG keeps the coefficients of the full size, even for a draft
MEMORY_SHARE = 4  # one photo may take the machine's memory divided by this
DRAFTS = (1, 2, 4, 8)  # divisors of the size at which a JPEG can be decoded
ROWS = 256  # rows of pixels that are converted at a time
ORIENTATION, SIDEWAYS = 0x0112, (5, 6, 7, 8)  # EXIF tag, and its values for photos turned by 90 degrees
BITS_PER_SAMPLE = 258  # TIFF tag

_limit: int | None = None


def limit_memory(limit: int | None) -> None:
    """Sets the number of bytes that decoding one photo may take.

    None is a fixed fraction of the machine's memory. The process shares the limit.
    """
    global _limit
    _limit = limit


def memory_limit() -> int:
    """Returns the number of bytes that decoding one photo may take."""
    return machine_memory() // MEMORY_SHARE if _limit is None else _limit


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


def header_of(path: Path, *, upright: bool = False) -> Header:
    """Returns the size of a photo from its header alone.

    Args:
        path: path of the photo.
        upright: apply the EXIF orientation. A PNG may store it behind the pixels, and is then decoded.

    Raises:
        DatasetError: if the file is not a photo, is damaged, or would not fit into memory.
    """
    with opened(path) as image:
        header = _fitting(path, image)
        if upright and _orientation(image) in SIDEWAYS:
            return Header(header.size[::-1], header.divisor)
        return header


def size_of(path: Path, *, upright: bool = False) -> tuple[int, int]:
    """Returns the width and height to which `read` decodes a photo; see `header_of`."""
    return header_of(path, upright=upright).size


def read(path: Path, *, upright: bool = False, divisor: int | None = None) -> Pixels:
    """Decodes a photo to 8-bit RGB, or RGBA where it has an alpha channel.

    Photos of 10 to 16 bits are scaled to 8.

    Args:
        path: path of the photo.
        upright: apply the EXIF orientation.
        divisor: factor by which the photo is decoded smaller, from `header_of`. None computes it.

    Raises:
        DatasetError: if the file is not a photo, is damaged, has no 8-bit equivalent, or would not fit into
            memory.
    """
    pixels, orientation = _decoded(path, divisor)
    return np.ascontiguousarray(_turned(pixels, orientation if upright else 1))


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
        small = Image.fromarray(_eight_bits(path, image))
        small.thumbnail((side, side), Image.Resampling.BOX)
        return np.array(small)


def read_mask(path: Path) -> Mask:
    """Decodes a mask, which is true wherever the picture is not black.

    Raises:
        DatasetError: if the file is not a picture, is damaged, or would not fit into memory.
    """
    with opened(path, "mask", "Make it again.") as image:
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
def opened(
    path: Path, what: str = "photo", way_out: str = "Restore it from the camera."
) -> Iterator["Image.Image"]:
    """Opens a picture of a known format without decoding it. Exceptions inside become errors about it.

    Args:
        path: path of the picture.
        what: noun for the picture in the message.
        way_out: end of the message about a damaged picture.

    Raises:
        DatasetError: if there is no such picture, or it is damaged.
    """
    if not path.exists():
        raise DatasetError(f"{path}: no such {what}.")
    with path.open("rb") as file:
        with blamed_on(path, f"not a {what} that can be read", way_out, DatasetError):
            image = _identified(path, file, what)
        with blamed_on(path, f"the {what} is damaged", way_out, DatasetError), image:
            yield image


def _identified(path: Path, file: BinaryIO, what: str) -> "Image.Image":
    """Opens a picture as `PIL.Image.open` does, without its limit of pixels; see the top of this file."""
    # Importing a plugin registers it.
    from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin

    del BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin
    prefix = file.read(16)
    for name in FORMATS:
        factory, accept = Image.OPEN.get(name, (None, None))
        if factory is not None and (accept is None or accept(prefix) is True):
            file.seek(0)
            # If Pillow gets the name, it maps some files into memory. A file that is truncated meanwhile
            # would then kill the process, and an uncompressed TIFF that must be turned would be scrambled.
            return factory(file, "")
    raise DatasetError(
        f"{path}: not a {what} that can be read. Photos are {', '.join(sorted(SUFFIXES))}: convert it to one "
        "of them."
    )


def _decoded(path: Path, divisor: int | None) -> tuple[Pixels, int]:
    """Returns the pixels as they are stored, and the EXIF orientation. Pillow's copy is freed."""
    with opened(path) as image:
        header = _fitting(path, image) if divisor is None else Header(_divided(image.size, divisor), divisor)
        if header.divisor > 1:
            image.draft(None, header.size)
        return _eight_bits(path, image), _orientation(image)


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


def _eight_bits(path: Path, image: "Image.Image") -> Pixels:
    """Decodes an opened photo a few rows at a time, so that memory holds two copies of it instead of four."""
    if image.mode in ("I", "F"):
        kind = "32-bit whole" if image.mode == "I" else "floating-point"
        raise DatasetError(
            f"{path}: it holds {kind} numbers, which do not say what is white. Save the photo with 8 or 16 "
            "bits a channel."
        )
    image.load()
    width, height = image.size
    alpha = image.has_transparency_data
    pixels = np.empty((height, width, 4 if alpha else 3), np.uint8)
    for top in range(0, height, ROWS):
        strip = image.crop((0, top, width, min(top + ROWS, height)))
        if image.mode.startswith("I;16"):
            pixels[top : top + ROWS] = _from_16_bits(image, np.asarray(strip), alpha)
        else:
            pixels[top : top + ROWS] = np.asarray(strip.convert("RGBA" if alpha else "RGB"))
    return pixels


def _from_16_bits(image: "Image.Image", levels: np.ndarray, alpha: bool) -> Pixels:
    """Scales one grey channel of up to 16 bits, which Pillow would clip at 255, to 8-bit RGB or RGBA."""
    bits = _bits(image)
    white = (1 << bits) - 1
    grey = (np.minimum(levels, white).astype(np.uint32) * 255 + white // 2) // white
    channels = [grey.astype(np.uint8)] * 3
    if alpha:  # a PNG may declare one level to be transparent
        channels.append(np.where(levels == image.info["transparency"], np.uint8(0), np.uint8(255)))
    return np.stack(channels, axis=2)


def _bits(image: "Image.Image") -> int:
    """Returns the bits of a grey level: 16, or the number in the tags of a TIFF."""
    tags = getattr(image, "tag_v2", None)
    return int(tags[BITS_PER_SAMPLE][0]) if tags is not None and BITS_PER_SAMPLE in tags else 16


def _orientation(image: "Image.Image") -> int:
    """Returns the EXIF orientation, from 1 to 8; 1 if there is none. Pillow turns TIFFs itself."""
    found = 1 if image.format == "TIFF" else image.getexif().get(ORIENTATION)
    return found if isinstance(found, int) else 1


def _turned(pixels: Pixels, orientation: int) -> Pixels:
    """Turns a photo upright, given its EXIF orientation (1 to 8)."""
    match orientation:
        case 2:
            return pixels[:, ::-1]
        case 3:
            return pixels[::-1, ::-1]
        case 4:
            return pixels[::-1]
        case 5:
            return pixels.transpose(1, 0, 2)
        case 6:
            return np.rot90(pixels, -1)
        case 7:
            return pixels[::-1, ::-1].transpose(1, 0, 2)
        case 8:
            return np.rot90(pixels)
        case _:
            return pixels
