"""Quantization that several formats share: levels of a range, opacities, smallest-three quaternions."""

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt32

SQRT_HALF = np.float32(0.5**0.5)  # largest magnitude of the three smallest components of a unit quaternion
LEAST_LOG_SCALE = -20.0  # replaces -inf of a flat Gaussian if a format needs a finite number


def levels(fractions: np.ndarray, top: int) -> np.ndarray:
    """Rounds numbers in [0, 1] to the nearest level of 0 .. top, after clipping them to [0, 1]."""
    return np.rint(np.clip(fractions, 0, 1) * np.float32(top)).astype(np.uint32)


def opacity_levels(logits: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Returns opacities in 8 bits, from their logits."""
    return levels(1 / (1 + np.exp(-np.clip(logits, -80, 80))), 255).astype(np.uint8)


def opacity_logits(levels: np.ndarray) -> Float[np.ndarray, " n"]:
    """Returns the logits of 8-bit opacities. Levels 0 and 255 move inward by half a level to stay finite."""
    opacities = np.clip(levels.astype(np.float32) / 255, 0.5 / 255, 1 - 0.5 / 255)
    return np.log(opacities / (1 - opacities)).astype(np.float32)


def finite_log_scales(log_scales: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Replaces -inf, the log scale of a flat Gaussian, by `LEAST_LOG_SCALE`."""
    return np.maximum(log_scales, np.float32(LEAST_LOG_SCALE))


def unit(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Returns unit quaternions; zero becomes the identity, as in rendering."""
    norms = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    identity = np.array([1, 0, 0, 0], np.float32)
    return np.where(norms > 0, quats / np.where(norms > 0, norms, 1), identity).astype(np.float32)


def smallest_three(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Returns the index of each unit quaternion's largest component, and the other components in order.

    The sign of the quaternion is chosen so that the largest component is positive.
    """
    largest = np.argmax(np.abs(quats), axis=1)
    rows = np.arange(len(quats))
    signs = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, quats[rows[:, None], others] * signs[:, None]


def from_smallest_three(
    largest: Int[np.ndarray, " n"], others: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4"]:
    """Returns the unit quaternions that `smallest_three` was applied to."""
    rest = np.sqrt(np.maximum(1 - np.sum(np.square(others), axis=1), 0))
    quats = np.empty((len(others), 4), np.float32)
    for index in range(4):
        rows = largest == index
        quats[rows] = np.insert(others[rows], index, rest[rows], axis=1)
    return quats


def pack(fields: np.ndarray, *widths: int) -> UInt32[np.ndarray, " n"]:
    """Returns 32-bit words of whole numbers, the first in the highest bits."""
    words = np.zeros(len(fields), np.uint32)
    for column, width in enumerate(widths):
        words = (words << np.uint32(width)) | fields[:, column].astype(np.uint32)
    return words


def unpack(words: np.ndarray, *widths: int) -> UInt32[np.ndarray, "n k"]:
    """Returns the whole numbers that `pack` was applied to."""
    fields, shift = [], sum(widths)
    for width in widths:
        shift -= width
        fields.append((words >> np.uint32(shift)) & np.uint32((1 << width) - 1))
    return np.stack(fields, axis=1)
