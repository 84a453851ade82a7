"""360-degree photos: how they are recognised, and the pinhole photos that features are found in.

A panorama is cut into the faces of a cube, which are a little wider than 90 degrees so that features at
their borders are found too. Structure from motion moves the faces of a panorama together, as a rig whose
rotations are known. The capture then gets the panorama itself.
"""

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from splatax.dataset import Pixels
from splatax.resampling import resize

if TYPE_CHECKING:
    from PIL.Image import Image

Panoramas = Literal["auto", "all", "none"]
FIELD = math.radians(100)  # angle that a face shows across
XMP_OF_FORMAT = ("xmp", "XML:com.adobe.xmp")  # where Pillow keeps it: of JPEG, TIFF and WebP; of PNG
XMP_OF_TIFF = 700


@dataclass(frozen=True)
class Face:
    """One of the pinhole photos that a panorama is cut into.

    Attributes:
        name: end of its name.
        rotation: face_from_panorama; both have x right, y down and z forward.
    """

    name: str
    rotation: tuple[tuple[int, int, int], ...]


FACES = (  # rows: the face's right, down and forward in the panorama; the first face is the rig itself
    Face("front", ((1, 0, 0), (0, 1, 0), (0, 0, 1))),
    Face("right", ((0, 0, -1), (0, 1, 0), (1, 0, 0))),
    Face("back", ((-1, 0, 0), (0, 1, 0), (0, 0, -1))),
    Face("left", ((0, 0, 1), (0, 1, 0), (-1, 0, 0))),
    Face("up", ((1, 0, 0), (0, 0, 1), (0, -1, 0))),
    Face("down", ((1, 0, 0), (0, 0, -1), (0, 1, 0))),
)


def looks_like_one(size: tuple[int, int]) -> bool:
    """Returns whether a photo is twice as wide as it is high."""
    return size[0] == 2 * size[1]


def says_so(image: "Image") -> bool:
    """Returns whether the metadata of an opened photo call it a complete equirectangular panorama (GPano)."""
    text = xmp_of(image)
    if (tag(text, "ProjectionType") or "").lower() != "equirectangular":
        return False
    return all(
        tag(text, f"CroppedAreaImage{side}Pixels") == tag(text, f"FullPano{side}Pixels")
        for side in ("Width", "Height")
    )


def xmp_of(image: "Image") -> str:
    """Returns the XMP metadata of an opened photo; an empty text if it has none."""
    found = next((image.info[name] for name in XMP_OF_FORMAT if name in image.info), b"")
    if not found and image.format == "TIFF":
        found = image.getexif().get(XMP_OF_TIFF, b"")
    return found.decode("utf8", "replace") if isinstance(found, bytes) else str(found)


def tag(text: str, name: str) -> str | None:
    """Returns the value of a GPano tag, which XMP may write as an attribute or as an element."""
    match = re.search(rf'GPano:{name}\s*(?:=\s*["\']|>)\s*([^"\'<]*)', text)
    return match[1].strip() if match else None


def focal_of_faces(size: int) -> float:
    """Returns the focal length of faces of this size, pixels."""
    return size / 2 / math.tan(FIELD / 2)


def size_of_faces(width: int, longest_side: int) -> int:
    """Returns the width and height of the faces of a panorama, in pixels.

    In its middle, a face has the pixels per degree of the panorama's middle.

    Args:
        width: of the panorama, pixels.
        longest_side: limit, pixels.
    """
    return min(round(2 * math.tan(FIELD / 2) * width / (2 * math.pi)), longest_side)


def cut(panorama: Pixels, face: Face, size: int) -> Pixels:
    """Returns a face of a panorama, a pinhole photo of `size` x `size` pixels."""
    from scipy import ndimage

    middles = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(middles / focal_of_faces(size), middles / focal_of_faces(size))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.array(face.rotation, float)
    width = round(2 * math.pi * focal_of_faces(size))
    if width < panorama.shape[1]:  # else pixels between those that are sampled would be lost
        panorama = resize(panorama, width, max(width // 2, 1))
    columns, rows = in_panorama(rays, panorama.shape[1], panorama.shape[0])
    around = np.pad(panorama, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    places = np.stack([rows - 0.5, columns + 0.5])  # from the middle of the first pixel, with one more before
    channels = [
        ndimage.map_coordinates(channel, places, np.float32, order=1, mode="nearest")
        for channel in np.moveaxis(around, 2, 0)
    ]
    return np.clip(np.round(np.stack(channels, axis=-1)), 0, 255).astype(np.uint8)


def in_panorama(
    rays: Float[np.ndarray, "*n 3"], width: int, height: int
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Returns the columns and rows at which a panorama shows directions in its own axes, in pixels."""
    x, y, z = np.moveaxis(rays, -1, 0)
    columns = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * width
    return columns, (np.arctan2(y, np.hypot(x, z)) / math.pi + 0.5) * height


def pixels_in_panorama(
    pixels: Float[np.ndarray, "n 2"], face: Face, size: int, panorama: tuple[int, int]
) -> Float[np.ndarray, "n 2"]:
    """Returns the pixels of a panorama that show what pixels of one of its faces show.

    Args:
        pixels: of the face, from its corner.
        face: of the panorama.
        size: width and height of the face, pixels.
        panorama: width and height of the panorama, pixels.
    """
    slopes = (pixels - size / 2) / focal_of_faces(size)
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ np.array(face.rotation, float)
    return np.stack(in_panorama(rays, *panorama), axis=-1)
