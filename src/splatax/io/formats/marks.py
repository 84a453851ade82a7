"""Comments in scene files that say how a scene was trained, and how large it is."""

import math
from collections.abc import Iterable

from splatax.low_pass import Antialiasing, LowPass

MIP = "SplatRenderMode: mip"  # trained with antialiasing
PLAIN = "SplatRenderMode: default"
MARKS = (MIP, PLAIN)
METRES = "Metres per unit: "  # before the number


def mark(low_pass: LowPass) -> str:
    """Returns the comment that names the filter of a scene."""
    return MIP if isinstance(low_pass, Antialiasing) else PLAIN


def metres_mark(metres_per_unit: float) -> str:
    """Returns the comment that says how many metres one unit of the scene has."""
    return f"{METRES}{metres_per_unit!r}"


def metres_in(comments: Iterable[str]) -> float | None:
    """Returns how many metres one unit has, as the comments of a file say; None if they do not.

    Raises:
        ValueError: if the comment holds something other than a number above zero.
    """
    for line in comments:
        if line.startswith(METRES):
            scale = float(line.removeprefix(METRES))
            if not 0 < scale < math.inf:
                raise ValueError(f"one unit cannot have {scale} metres")
            return scale
    return None
