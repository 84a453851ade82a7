"""Photos and pictures: decode, measure, encode."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps, UnidentifiedImageError

from splatax.dataset import Mask, Pixels
from splatax.errors import DatasetError
from splatax.io.files import write_whole

SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}


def is_image(path: Path) -> bool:
    """Whether the name is that of a photo."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def size_of(path: Path, *, upright: bool = False) -> tuple[int, int]:
    """Width and height, from the header alone; after turning by EXIF if `upright`.

    Raises:
        DatasetError: if the file is not an image.
    """
    with _open(path) as image:
        if upright and image.getexif().get(0x0112, 1) >= 5:
            return image.height, image.width
        return image.size


def read(path: Path, *, upright: bool = False) -> Pixels:
    """Decodes a photo to 8-bit RGB, or RGBA where it has an alpha channel.

    Args:
        path: of the photo.
        upright: turn it as its EXIF orientation says.

    Raises:
        DatasetError: if the file is not an image, or is damaged.
    """
    with _open(path) as image:
        try:
            if upright:
                image = ImageOps.exif_transpose(image)
            mode = "RGBA" if image.has_transparency_data else "RGB"
            return np.array(image.convert(mode))
        except (OSError, SyntaxError) as error:
            raise DatasetError(
                f"{path}: the photo is damaged ({error}). Restore it from the camera."
            ) from error


def read_mask(path: Path) -> Mask:
    """Decodes a mask: true wherever the picture is not black.

    Raises:
        DatasetError: if the file is not an image, or is damaged.
    """
    with _open(path) as image:
        try:
            one_channel = image.mode in ("1", "L", "I", "I;16", "F")
            shades = np.atleast_3d(np.array(image if one_channel else image.convert("RGB")))
        except (OSError, SyntaxError) as error:
            raise DatasetError(f"{path}: the mask is damaged ({error}). Make it again.") from error
    return np.any(shades != 0, axis=2)


def write(path: Path, pixels: UInt8[np.ndarray, "h w 3"]) -> None:
    """Writes a PNG, whole or not at all."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_whole(path, buffer.getvalue())


def _open(path: Path) -> Image.Image:
    try:
        return Image.open(path)
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such photo.") from None
    except Image.DecompressionBombError as error:
        raise DatasetError(f"{path}: more pixels than can be read. Shrink the photo.") from error
    except (UnidentifiedImageError, OSError) as error:
        raise DatasetError(f"{path}: not a photo that can be read ({error}).") from error
