"""Resampling of photos and masks: each new pixel is the mean of the area that it covers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt32

from splatax.dataset import Mask, Pixels
from splatax.packages import required_by

HALF, ALL = 0.5, 1 - 1e-3  # fractions of a pixel's area; ALL leaves room for rounding
LEVELS = 256  # parts of a pixel that bilinear interpolation distinguishes: 8 bits
AT_A_TIME = 1 << 14  # pixels that are interpolated together, few enough to stay in the processor's cache
ALTERNATE = np.uint32(0x00FF00FF)  # two of the four channels of a pixel in one number
HALVES = np.uint32(0x00800080)  # one half in each, before the lowest 8 bits are dropped


def resize(pixels: Pixels, width: int, height: int) -> Pixels:
    """Resizes a photo. Colours are weighted by alpha, so transparent pixels do not bleed into others."""
    if pixels.shape[:2] == (height, width):
        return pixels
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:].astype(np.float64) / 255
        premultiplied = _area_mean(pixels[..., :3] * alpha, width, height)
        mean_alpha = _area_mean(alpha, width, height)
        color = premultiplied / np.where(mean_alpha > 0, mean_alpha, 1)
        return np.round(np.concatenate([color, mean_alpha * 255], axis=2)).astype(np.uint8)
    with required_by("resizing photos"):
        from PIL import Image
    return np.array(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))


def resize_mask(mask: Mask, width: int, height: int, above: float = HALF) -> Mask:
    """Resizes a mask.

    Args:
        mask: true where a pixel counts.
        width: of the new mask.
        height: of the new mask.
        above: a new pixel counts if more than this fraction of its area does; `ALL` for the whole area.
    """
    if mask.shape == (height, width):
        return mask
    return _area_mean(mask[..., None].astype(np.float32), width, height)[..., 0] > above


def _area_mean(values: Float[np.ndarray, "_ _ c"], width: int, height: int) -> Float[np.ndarray, "_ _ c"]:
    with required_by("resizing photos"):
        from PIL import Image
    planes = [Image.fromarray(plane.astype(np.float32)) for plane in np.moveaxis(values, 2, 0)]
    return np.stack([np.array(p.resize((width, height), Image.Resampling.BOX)) for p in planes], axis=2)


@dataclass(frozen=True)
class Places:
    """Places between the pixels of a photo; pixel centres are whole numbers. Those outside are at its edge.

    Attributes:
        index: number of the pixel above and to the left of each place, row after row.
        right: distance of the place from its column, in 1/256 of a pixel.
        below: distance of the place from its row.
    """

    index: Int[np.ndarray, "h w"]
    right: UInt8[np.ndarray, "h w"]
    below: UInt8[np.ndarray, "h w"]


def places_at(
    rows: Float[np.ndarray, "h w"], columns: Float[np.ndarray, "h w"], size: tuple[int, int]
) -> Places:
    """Returns places in a photo whose width and height are given, at least 2 pixels each."""
    width, height = size
    column, right = _split(columns, width)
    row, below = _split(rows, height)
    return Places((row * width + column).astype(np.int32), right, below)


def _split(
    places: Float[np.ndarray, "h w"], count: int
) -> tuple[Int[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Returns places along one axis as whole pixels, of which another one follows, and 1/256 of a pixel."""
    last = LEVELS * (count - 1) - 1
    # The result is zero where a lens is not defined, which np.clip would leave as it is.
    finest = np.fmin(np.fmax(np.round(places * np.float32(LEVELS)), 0), last).astype(np.int32)
    return finest >> 8, (finest & 255).astype(np.uint8)


def interpolated(pixels: Pixels, places: Places) -> Pixels:
    """Returns the photo at these places, by bilinear interpolation in 8-bit numbers."""
    height, width, channels = pixels.shape
    packed = np.zeros((height, width, 4), np.uint8)
    packed[..., :channels] = _premultiplied(pixels) if channels == 4 else pixels
    words = packed.view(np.uint32).ravel()
    found = np.empty(places.index.shape, np.uint32)
    strip = max(1, AT_A_TIME * len(found) // found.size)
    for top in range(0, len(found), strip):
        rows = slice(top, top + strip)
        right, below = (distance[rows].astype(np.uint32) for distance in (places.right, places.below))
        index = places.index[rows].astype(np.intp)
        corners = [words.take(index + step) for step in (0, 1, width, width + 1)]
        pairs = []
        for shift in (0, 8):  # two channels at a time, with 8 bits to spare beside each
            a, b, c, d = ((corner >> shift) & ALTERNATE for corner in corners)
            pairs.append(_between(_between(a, b, right), _between(c, d, right), below))
        found[rows] = pairs[0] | pairs[1] << 8
    result = found.view(np.uint8).reshape(*found.shape, 4)[..., :channels]
    return _straight(result) if channels == 4 else np.ascontiguousarray(result)


def _between(
    first: UInt32[np.ndarray, "h w"], last: UInt32[np.ndarray, "h w"], place: UInt32[np.ndarray, "h w"]
) -> UInt32[np.ndarray, "h w"]:
    """Returns the levels at a place between two pixels, 0 to 255 of 256, for two channels in each number."""
    first *= LEVELS - place
    last *= place
    first += last
    first += HALVES
    first >>= 8
    first &= ALTERNATE
    return first


def _premultiplied(pixels: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    alpha = pixels[..., 3:].astype(np.uint16)
    return np.concatenate(
        [((pixels[..., :3] * alpha + 127) // 255).astype(np.uint8), pixels[..., 3:]], axis=2
    )


def _straight(pixels: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    alpha = np.maximum(pixels[..., 3:], 1).astype(np.uint16)
    colors = np.minimum((pixels[..., :3] * np.uint16(255) + alpha // 2) // alpha, 255)
    return np.concatenate([colors.astype(np.uint8), pixels[..., 3:]], axis=2)
