"""How close two pictures are, on 8-bit images in double precision, as papers report it."""

import math

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import correlate1d

from splatax.losses import KERNEL, WINDOW

SSIM_PROTOCOL = "11x11 Gaussian window, sigma 1.5, valid windows only, mean over RGB, 8-bit images"


def to_8bit(image: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """Rounds values in [0, 1] to the nearest of 256 levels; clips the rest."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def psnr(image: UInt8[np.ndarray, "h w c"], photo: UInt8[np.ndarray, "h w c"]) -> float:
    """Peak signal-to-noise ratio, dB; infinite for equal images."""
    error = float(np.mean(np.square(image.astype(np.float64) - photo)))
    return 10 * math.log10(255**2 / error) if error else math.inf


def ssim(image: UInt8[np.ndarray, "h w c"], photo: UInt8[np.ndarray, "h w c"]) -> float:
    """Structural similarity (Wang et al. 2004), as scikit-image computes it.

    `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)`: the mean
    over windows that lie inside the image.

    Raises:
        ValueError: if the image is smaller than the window.
    """
    if min(image.shape[:2]) < WINDOW:
        height, width = image.shape[:2]
        raise ValueError(f"SSIM needs at least {WINDOW} x {WINDOW} pixels, not {width} x {height}")
    x, y = image.astype(np.float64), photo.astype(np.float64)
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    mean_x, mean_y = _window_means(x), _window_means(y)
    variance_x = _window_means(x * x) - mean_x**2
    variance_y = _window_means(y * y) - mean_y**2
    covariance = _window_means(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return float(np.mean(luminance * structure))


def _window_means(values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h2 w2 c"]:
    """Gaussian weighted means of the windows that lie inside."""
    edge = WINDOW // 2
    blurred = correlate1d(correlate1d(values, KERNEL, axis=0), KERNEL, axis=1)
    return blurred[edge:-edge, edge:-edge]
