"""How formats squeeze numbers: levels of a range, opacities, quaternions without their largest part."""

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt32

SQRT_HALF = np.float32(0.5**0.5)  # the largest that any but the largest part of a unit quaternion can be
LEAST_LOG_SCALE = -20.0  # what stands for a flat Gaussian's, -inf, where a format needs a number


def levels(fractions: np.ndarray, top: int) -> np.ndarray:
    """Numbers in [0, 1] to the nearest of 0 .. top; those outside to the nearer end."""
    return np.rint(np.clip(fractions, 0, 1) * np.float32(top)).astype(np.uint32)


def opacity_levels(logits: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Opacity in 8 bits."""
    return levels(1 / (1 + np.exp(-np.clip(logits, -80, 80))), 255).astype(np.uint8)


def opacity_logits(levels: np.ndarray) -> Float[np.ndarray, " n"]:
    """The logits of 8-bit opacities, the ends half a level inside: a logit must stay finite."""
    opacities = np.clip(levels.astype(np.float32) / 255, 0.5 / 255, 1 - 0.5 / 255)
    return np.log(opacities / (1 - opacities)).astype(np.float32)


def finite_log_scales(log_scales: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """With -inf, which is flat, as a number that is as good as flat."""
    return np.maximum(log_scales, np.float32(LEAST_LOG_SCALE))


def unit(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Normalized; zero becomes the identity, as when rendering."""
    norms = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    identity = np.array([1, 0, 0, 0], np.float32)
    return np.where(norms > 0, quats / np.where(norms > 0, norms, 1), identity).astype(np.float32)


def smallest_three(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """The index of the largest part of unit quaternions, which is made positive, and the others in order."""
    largest = np.argmax(np.abs(quats), axis=1)
    rows = np.arange(len(quats))
    signs = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, quats[rows[:, None], others] * signs[:, None]


def from_smallest_three(
    largest: Int[np.ndarray, " n"], others: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4"]:
    """Undoes `smallest_three`."""
    rest = np.sqrt(np.maximum(1 - np.sum(np.square(others), axis=1), 0))
    quats = np.empty((len(others), 4), np.float32)
    for index in range(4):
        rows = largest == index
        quats[rows] = np.insert(others[rows], index, rest[rows], axis=1)
    return quats


def pack(fields: np.ndarray, *widths: int) -> UInt32[np.ndarray, " n"]:
    """32-bit words of whole numbers, the first in the highest bits."""
    words = np.zeros(len(fields), np.uint32)
    for column, width in enumerate(widths):
        words = (words << np.uint32(width)) | fields[:, column].astype(np.uint32)
    return words


def unpack(words: np.ndarray, *widths: int) -> UInt32[np.ndarray, "n k"]:
    """Undoes `pack`."""
    fields, shift = [], sum(widths)
    for width in widths:
        shift -= width
        fields.append((words >> np.uint32(shift)) & np.uint32((1 << width) - 1))
    return np.stack(fields, axis=1)
