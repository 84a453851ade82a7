"""Checks of the joints that the vertices and splats of a file follow."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from splatax.errors import FormatError


def check_following(
    path: Path, joints: Float[np.ndarray, "v k"], weights: Float[np.ndarray, "v k"], count: int
) -> Int[np.ndarray, "v k"]:
    """Checks joints and weights that come from a file, and returns the joints as whole numbers.

    Args:
        path: the file.
        joints: indices into the joints of the skin.
        weights: of the joints.
        count: number of joints of the skin.

    Raises:
        FormatError: if a joint is not in the skin, or a weight is negative or not finite.
    """
    if not ((joints >= 0) & (joints < count)).all():  # false for NaN
        raise FormatError(
            f"{path}: damaged: a mesh follows joints that its skin does not have, whose joints are 0 to "
            f"{count - 1}. Get the file again."
        )
    if not (np.isfinite(weights) & (weights >= 0)).all():
        raise FormatError(f"{path}: damaged: weights are negative or not finite. Get the file again.")
    return joints.astype(np.int64)
