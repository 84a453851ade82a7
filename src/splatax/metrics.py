"""Image metrics as papers report them: PSNR and SSIM of 8-bit images, in double precision.

A mask is true where a pixel counts; without a mask, all pixels count.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8
from scipy.ndimage import correlate1d, minimum_filter

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
Mask = Bool[np.ndarray, "h w"] | None


def to_8bit(image: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """Rounds values to the nearest of 256 levels, after clipping them to [0, 1]."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def psnr(image: Num[np.ndarray, "h w c"], photo: UInt8[np.ndarray, "h w c"], mask: Mask = None) -> float:
    """Returns the peak signal-to-noise ratio of levels from 0 to 255, dB; infinite for equal images."""
    squares = np.square(image.astype(np.float64) - photo)
    error = float(np.mean(squares if mask is None else squares[mask]))
    return 10 * math.log10(255**2 / error) if error else math.inf


def color_corrected(
    image: UInt8[np.ndarray, "h w 3"], photo: UInt8[np.ndarray, "h w 3"], mask: Mask = None
) -> Float[np.ndarray, "h w 3"]:
    """Applies to an image the affine map of RGB that brings it closest to a photo.

    The map is y = M (x, 1), with the 3 x 4 matrix M of least squares over the pixels that count. The result
    is clipped to levels from 0 to 255. The map undoes differences in exposure and white balance, which a
    scene cannot know for a held-out photo, and nothing that varies over the image.
    """
    colors = np.concatenate([image / 255, np.ones((*image.shape[:2], 1))], axis=2)
    missing = photo - image.astype(
        np.float64
    )  # fitted instead of the photo, so that equal images stay equal bit by bit
    counted = np.ones(image.shape[:2], bool) if mask is None else mask
    x, y = colors[counted], missing[counted]
    fit, *_ = np.linalg.lstsq(x.T @ x, x.T @ y)
    return np.clip(image + colors @ fit, 0, 255)


def ssim(image: UInt8[np.ndarray, "h w c"], photo: UInt8[np.ndarray, "h w c"], mask: Mask = None) -> float:
    """Returns the structural similarity (Wang et al. 2004), as scikit-image computes it.

    It equals `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)`: the
    mean over the windows that lie inside the image and the mask.

    Raises:
        InputError: if no window lies inside both.
    """
    if min(image.shape[:2]) < WINDOW:
        height, width = image.shape[:2]
        raise InputError(f"SSIM needs at least {WINDOW} x {WINDOW} pixels, not {width} x {height}")
    x, y = image.astype(np.float64), photo.astype(np.float64)
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    mean_x, mean_y = _window_means(x), _window_means(y)
    variance_x = _window_means(x * x) - mean_x**2
    variance_y = _window_means(y * y) - mean_y**2
    covariance = _window_means(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    similarity = luminance * structure
    return float(np.mean(similarity if mask is None else similarity[_whole_windows(mask)]))


def _whole_windows(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h2 w2"]:
    """Returns a mask of the windows inside the image that lie inside the mask of pixels."""
    edge = WINDOW // 2
    inside = minimum_filter(mask, WINDOW)[edge:-edge, edge:-edge]
    if not inside.any():
        raise InputError(f"SSIM needs {WINDOW} x {WINDOW} pixels in one piece, and the mask has none")
    return inside


def _window_means(values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h2 w2 c"]:
    """Returns Gaussian weighted means over the windows inside the image."""
    edge = WINDOW // 2
    blurred = correlate1d(correlate1d(values, KERNEL, axis=0), KERNEL, axis=1)
    return blurred[edge:-edge, edge:-edge]
