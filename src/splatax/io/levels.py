"""Pixels of an opened picture: converted to 8 bits per channel, and turned upright."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatax.dataset import Pixels
from splatax.errors import DatasetError

if TYPE_CHECKING:
    from PIL import Image

ROWS = 256  # rows of pixels that are converted at a time
ORIENTATION, SIDEWAYS = 0x0112, (5, 6, 7, 8)  # EXIF tag, and its values for photos turned by 90 degrees
BITS_PER_SAMPLE = 258  # TIFF tag


def eight_bits(path: Path, image: "Image.Image") -> Pixels:
    """Decodes an opened photo a few rows at a time, so that memory holds two copies of it instead of four."""
    if image.mode in ("I", "F"):
        kind = "32-bit whole" if image.mode == "I" else "floating-point"
        raise DatasetError(
            f"{path}: it holds {kind} numbers, which do not say what is white. Save the photo with 8 or 16 "
            "bits per channel."
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


def orientation(image: "Image.Image") -> int:
    """Returns the EXIF orientation, from 1 to 8; 1 if there is none. Pillow turns TIFFs itself."""
    found = 1 if image.format == "TIFF" else image.getexif().get(ORIENTATION)
    return found if isinstance(found, int) else 1


def turned(pixels: Pixels, orientation: int) -> Pixels:
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
