"""360-degree photos: how they are recognised, and the pinhole photos that they are cut into.

A panorama is cut into the faces of a cube. Features are found in faces that are a little wider than 90
degrees, so that those at their borders are found too. Structure from motion moves the faces of a panorama
together, as a rig whose rotations are known. The capture then gets faces of 90 degrees, or the panorama.
"""

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from splatax.dataset import Pixels
from splatax.resampling import resize

if TYPE_CHECKING:
    from PIL.Image import Image

Panoramas = Literal["auto", "all", "none"]
SEARCHED = math.radians(100)  # angle across a face in which features are found
SHOWN = math.radians(90)  # angle across a face of the capture: together they show everything once
MARGIN = 12  # pixels around a panorama that continue it, for splines
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


def focal_of_faces(size: int, field: float) -> float:
    """Returns the focal length of faces of this size that show an angle, radians, in pixels."""
    return size / 2 / math.tan(field / 2)


def size_of_faces(width: int, field: float) -> int:
    """Returns the width and height of the faces of a panorama, in pixels: an even number.

    In its middle, where a face has the fewest pixels per degree, it has those of the panorama's equator.

    Args:
        width: of the panorama, pixels.
        field: angle that a face shows across, radians.
    """
    return 2 * math.ceil(math.tan(field / 2) * width / (2 * math.pi))


def faces_of(panorama: Pixels, size: int, field: float) -> list[Pixels]:
    """Returns the faces of a panorama in the order of `FACES`, pinhole photos of `size` x `size` pixels.

    They are resampled by cubic splines, from a panorama that is shrunk first if the faces are smaller.

    Args:
        panorama: of any size.
        size: of the faces, pixels.
        field: angle that a face shows across, radians.
    """
    from scipy import ndimage

    focal = focal_of_faces(size, field)
    width = round(2 * math.pi * focal)
    if width < panorama.shape[1]:  # else pixels between those that are sampled would be lost
        panorama = resize(panorama, width, max(width // 2, 1))
    height, width = panorama.shape[:2]
    middles = (np.arange(size) + 0.5 - size / 2) / focal
    x, y = np.meshgrid(middles, middles)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    faces = [np.empty((size, size, panorama.shape[2]), np.uint8) for _ in FACES]
    for channel in range(panorama.shape[2]):  # one after the other, for the memory of large panoramas
        splines = ndimage.spline_filter(continued(panorama[..., channel]), 3, np.float32, mode="nearest")
        for pixels, face in zip(faces, FACES, strict=True):
            columns, rows = in_panorama(rays @ np.array(face.rotation, float), width, height)
            places = np.stack([rows, columns]) + (MARGIN - 0.5)  # from the middle of the first pixel
            found = ndimage.map_coordinates(splines, places, np.float32, order=3, prefilter=False)
            pixels[..., channel] = np.clip(np.round(found), 0, 255)
    return faces


def continued(channel: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "_ _"]:
    """Returns a channel of a panorama with `MARGIN` more pixels on each side.

    Beyond the left is the right; beyond a pole is the other side of the panorama, upside down.
    """
    margin = min(MARGIN, *channel.shape)
    opposite = np.roll(channel, channel.shape[1] // 2, axis=1)
    tall = np.concatenate([opposite[margin - 1 :: -1], channel, opposite[: -margin - 1 : -1]])
    beyond = MARGIN - margin  # of panorama that are smaller than the margin, which have no detail anyway
    return np.pad(
        np.pad(tall, ((beyond, beyond), (0, 0)), mode="edge"), ((0, 0), (MARGIN, MARGIN)), mode="wrap"
    )


def in_panorama(
    rays: Float[np.ndarray, "*n 3"], width: int, height: int
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Returns the columns and rows at which a panorama shows directions in its own axes, in pixels."""
    x, y, z = np.moveaxis(rays, -1, 0)
    columns = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * width
    return columns, (np.arctan2(y, np.hypot(x, z)) / math.pi + 0.5) * height


def rays_of(pixels: Float[np.ndarray, "n 2"], face: Face, size: int) -> Float[np.ndarray, "n 3"]:
    """Returns what pixels of a face in which features are found show: directions in the panorama's axes.

    Args:
        pixels: of the face, from its corner.
        face: of the panorama.
        size: width and height of the face, pixels.
    """
    slopes = (pixels - size / 2) / focal_of_faces(size, SEARCHED)
    return np.column_stack([slopes, np.ones(len(slopes))]) @ np.array(face.rotation, float)


def pixels_in_faces(
    rays: Float[np.ndarray, "n 3"], size: int
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Returns the faces of the capture that show directions, as indices of `FACES`, and the pixels there.

    Args:
        rays: directions in the panorama's axes.
        size: width and height of the faces, pixels.
    """
    turned = np.einsum("fij,nj->nfi", np.array([face.rotation for face in FACES], float), rays)
    chosen = turned[..., 2].argmax(axis=1)
    local = turned[np.arange(len(rays)), chosen]
    return chosen, local[:, :2] / local[:, 2:] * focal_of_faces(size, SHOWN) + size / 2
