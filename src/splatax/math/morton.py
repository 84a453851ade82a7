"""Morton order: neighbours in space are mostly neighbours in the list."""

import numpy as np
from jaxtyping import Float, Int

BITS = 21  # bits of each axis: three times 21 fit in 64


def order(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Returns the indices that sort points along a Z-order curve through their bounding box (Morton 1966)."""
    if len(points) == 0:
        return np.zeros(0, int)
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    cells = (points - low) / np.where(high > low, high - low, 1) * ((1 << BITS) - 1)
    codes = np.zeros(len(points), np.uint64)
    for axis in range(3):
        codes |= _spread(cells[:, axis].astype(np.uint64)) << np.uint64(axis)
    return np.argsort(codes, kind="stable")


def _spread(values: np.ndarray) -> np.ndarray:
    """Moves bit i to bit 3 i, in blocks of bits that halve in size."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
