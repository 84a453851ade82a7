"""Resampling of photos and masks: each new pixel is the mean of the area that it covers."""

import numpy as np
from jaxtyping import Float

from splatax.dataset import Mask, Pixels
from splatax.packages import required_by

HALF, ALL = 0.5, 1 - 1e-3  # fractions of a pixel's area; ALL leaves room for rounding


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
