"""Image metrics as papers report them: PSNR and SSIM of 8-bit images. All sums are in double precision.

A mask is true where a pixel counts; without a mask, all pixels count.
"""

import math
from collections.abc import Iterator, Sequence
from types import EllipsisType

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8
from scipy.ndimage import minimum_filter

from splatax.errors import InputError
from splatax.losses import KERNEL, WINDOW

PSNR_PROTOCOL = "per view over all RGB values, then the mean over views"
SSIM_PROTOCOL = "11x11 Gaussian window, sigma 1.5, valid windows only, mean over RGB, 8-bit images"
CORRECTION_PROTOCOL = (
    "PSNR after the affine map of the rendering's colours (3x4, least squares, one for each view) that "
    "brings them closest to the photo; clipped, not rounded again"
)
MASK_PROTOCOL = (
    "pixels outside a mask count nowhere: no part in PSNR or in the colour fit, no SSIM window that "
    "touches them; for LPIPS both pictures are black there and the score is divided by the fraction inside"
)
STRIP = 32  # rows that are worked on at a time
Mask = Bool[np.ndarray, "h w"] | None


def to_8bit(image: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """Rounds values to the nearest of 256 levels, after clipping them to [0, 1]."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def psnr(image: Num[np.ndarray, "h w c"], photo: UInt8[np.ndarray, "h w c"], mask: Mask = None) -> float:
    """Returns the peak signal-to-noise ratio of levels from 0 to 255, dB; infinite for equal images."""
    total = sum(
        float(np.sum(np.square(image[rows].astype(np.float64) - photo[rows])[_inside(mask, rows)]))
        for rows in _strips(len(image))
    )
    return _decibels(total, image.shape, mask)


def corrected_psnr(
    image: UInt8[np.ndarray, "h w 3"], photo: UInt8[np.ndarray, "h w 3"], mask: Mask = None
) -> float:
    """Returns the PSNR of `color_corrected(image, photo, mask)`, dB, without keeping that picture."""
    fit, total = _color_map(image, photo, mask), 0.0
    for rows in _strips(len(image)):
        error = np.square(_mapped(image[rows], fit) - photo[rows])
        total += float(np.sum(error[_inside(mask, rows)]))
    return _decibels(total, image.shape, mask)


def color_corrected(
    image: UInt8[np.ndarray, "h w 3"], photo: UInt8[np.ndarray, "h w 3"], mask: Mask = None
) -> Float[np.ndarray, "h w 3"]:
    """Applies to an image the affine map of RGB that brings it closest to a photo.

    The map is y = M (x, 1), with the 3 x 4 matrix M of least squares over the pixels that count. The result
    is clipped to levels from 0 to 255. The map undoes differences in exposure and white balance, which a
    scene cannot know for a held-out photo, and nothing that varies over the image.
    """
    fit = _color_map(image, photo, mask)
    return np.concatenate([_mapped(image[rows], fit) for rows in _strips(len(image))])


def ssim(image: UInt8[np.ndarray, "h w c"], photo: UInt8[np.ndarray, "h w c"], mask: Mask = None) -> float:
    """Returns the structural similarity (Wang et al. 2004), as scikit-image computes it.

    It equals `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)` up to
    1e-6, or 3e-5 for pictures that are nearly flat: the mean over the windows that lie inside the image and
    the mask.

    Raises:
        InputError: if no window lies inside both.
    """
    height, width, channels = image.shape
    if min(height, width) < WINDOW:
        raise InputError(f"SSIM needs at least {WINDOW} x {WINDOW} pixels, not {width} x {height}")
    whole = None if mask is None else _whole_windows(mask)
    count = (height - WINDOW + 1) * (width - WINDOW + 1) if whole is None else int(whole.sum())
    total = 0.0
    for rows in _strips(height - WINDOW + 1):
        seen = slice(rows.start, rows.stop + WINDOW - 1)
        for channel in range(channels):
            similarity = _similarities(image[seen, :, channel], photo[seen, :, channel])
            counted = similarity if whole is None else similarity[whole[rows]]
            total += float(np.sum(counted, dtype=np.float64))
    return total / (count * channels)


def _similarities(
    image: UInt8[np.ndarray, "h w"], photo: UInt8[np.ndarray, "h w"]
) -> Float[np.ndarray, "h2 w2"]:
    """Returns the similarity of each window inside one channel of two pictures, in single precision.

    Levels are counted from the middle, so that variances lose little to rounding.
    """
    middle, c1, c2 = np.float32(127.5), np.float32((0.01 * 255) ** 2), np.float32((0.03 * 255) ** 2)
    x, y = (picture.astype(np.float32, order="C") - middle for picture in (image, photo))
    mean_x, mean_y, squares, product = map(_window_means, (x, y, x * x + y * y, x * y))
    covariance = product - mean_x * mean_y
    variances = squares - (mean_x * mean_x + mean_y * mean_y)
    mean_x += middle
    mean_y += middle
    either = mean_x * mean_x + mean_y * mean_y
    return (2 * mean_x * mean_y + c1) / (either + c1) * (2 * covariance + c2) / (variances + c2)


def _color_map(
    image: UInt8[np.ndarray, "h w 3"], photo: UInt8[np.ndarray, "h w 3"], mask: Mask
) -> Float[np.ndarray, "4 3"]:
    """Returns the map of colours that `color_corrected` adds to an image."""
    moments, products = np.zeros((4, 4)), np.zeros((4, 3))
    for rows in _strips(len(image)):
        # The difference is fitted instead of the photo, so that equal images stay equal bit by bit.
        missing = photo[rows] - image[rows].astype(np.float64)
        inside = _inside(mask, rows)
        x, y = _with_one(image[rows])[inside].reshape(-1, 4), missing[inside].reshape(-1, 3)
        moments += x.T @ x
        products += x.T @ y
    return np.linalg.lstsq(moments, products)[0]


def _mapped(image: UInt8[np.ndarray, "h w 3"], fit: Float[np.ndarray, "4 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.clip(image + _with_one(image) @ fit, 0, 255)


def _with_one(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 4"]:
    """Returns colours in [0, 1], and a one behind each."""
    colors = np.ones((*image.shape[:2], 4))
    np.divide(image, 255, out=colors[..., :3])
    return colors


def _strips(height: int) -> Iterator[slice]:
    """Yields slices of rows: all of a picture, in parts that stay in the processor's cache."""
    return (slice(top, min(top + STRIP, height)) for top in range(0, height, STRIP))


def _inside(mask: Mask, rows: slice) -> EllipsisType | Bool[np.ndarray, "r w"]:
    """Returns the index of the pixels of a strip that count."""
    return ... if mask is None else mask[rows]


def _decibels(squares: float, shape: tuple[int, ...], mask: Mask) -> float:
    """Returns the PSNR for a sum of squared differences over all channels of the pixels that count."""
    count = shape[0] * shape[1] if mask is None else int(mask.sum())
    return 10 * math.log10(255**2 * count * shape[2] / squares) if squares else math.inf


def _whole_windows(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h2 w2"]:
    """Returns a mask of the windows inside the image that lie inside the mask of pixels."""
    edge = WINDOW // 2
    inside = minimum_filter(mask, WINDOW)[edge:-edge, edge:-edge]
    if not inside.any():
        raise InputError(f"SSIM needs {WINDOW} x {WINDOW} pixels in one piece, and the mask has none")
    return inside


def _window_means(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h2 w2"]:
    """Returns Gaussian weighted means over the windows inside a picture."""
    columns = _weighted([values[i : len(values) - WINDOW + 1 + i] for i in range(WINDOW)])
    width = values.shape[1] - WINDOW + 1
    return _weighted([columns[:, i : width + i] for i in range(WINDOW)])


def _weighted(shifted: Sequence[Float[np.ndarray, "h w"]]) -> Float[np.ndarray, "h w"]:
    """Returns the sum of the pictures with the weights of a window, which is symmetric."""
    edge = WINDOW // 2
    weights = np.asarray(KERNEL, shifted[edge].dtype)
    total = shifted[edge] * weights[edge]
    pair = np.empty_like(total)
    for i in range(edge):
        np.add(shifted[i], shifted[-1 - i], out=pair)
        pair *= weights[i]
        total += pair
    return total
