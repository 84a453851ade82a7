"""Pictures of pages in a browser, for tests."""

import io

import numpy as np
from PIL import Image


def picture(tab) -> np.ndarray:
    """The page without its buttons, RGB in [0, 1]."""
    tab.tell("document.body.classList.add('bare')")
    with Image.open(io.BytesIO(tab.tab.screenshot())) as image:
        return np.asarray(image.convert("RGB"), np.float32) / 255


def psnr(a, b) -> float:
    """Peak signal-to-noise ratio of two pictures, dB."""
    return float(-10 * np.log10(np.mean((a - b) ** 2)))
