"""Finds measurements of photos that are unlike those of the other photos."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from splatax.math.robust import MAD_TO_SIGMA

FEWEST_TO_COMPARE = 5  # photos of which one can be called an outlier
OUTLIER = 3.5  # robust standard deviations (Iglewicz and Hoaglin 1993)


def outliers(names: Sequence[str], values: Float[np.ndarray, " n"], floor: float, sign: int) -> list[str]:
    """Returns the names whose values are outliers on one side, the farthest first.

    Args:
        names: names of the photos.
        values: their measurements.
        floor: see `robust_scores`.
        sign: +1 for values above the others, -1 for values below.
    """
    if len(names) < FEWEST_TO_COMPARE:
        return []
    scores = sign * robust_scores(values, floor)
    return [names[i] for i in np.argsort(-scores, kind="stable") if scores[i] > OUTLIER]


def robust_scores(values: Float[np.ndarray, " n"], floor: float) -> Float[np.ndarray, " n"]:
    """Returns distances from the median, in standard deviations estimated by the median deviation.

    Args:
        values: measurements in any unit.
        floor: lower bound of the standard deviation, so that nearly equal photos have no outliers.
    """
    middle = np.median(values)
    sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(values - middle))), floor)
    return (values - middle) / sigma
