"""The curve of sRGB between display-referred values and linear light, for NumPy (IEC 61966-2-1)."""

import numpy as np
from jaxtyping import Float

TOE, SLOPE, OFFSET, POWER = 0.04045, 12.92, 0.055, 2.4


def to_linear(rgb: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the linear light of display-referred values, which are clipped to [0, 1]."""
    value = np.clip(rgb, 0, 1)
    return np.where(value > TOE, ((value + OFFSET) / (1 + OFFSET)) ** POWER, value / SLOPE)


def to_display(light: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the display-referred values of linear light, which is clipped to [0, 1]."""
    value = np.clip(light, 0, 1)
    return np.where(value > TOE / SLOPE, (1 + OFFSET) * value ** (1 / POWER) - OFFSET, value * SLOPE)
