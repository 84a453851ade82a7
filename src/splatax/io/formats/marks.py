"""Comments in scene files that say how a scene was trained, and how large it is."""

import math
from collections.abc import Iterable
from dataclasses import replace

from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays, Antialiasing, Dilation, LowPass

MIP = "SplatRenderMode: mip"  # trained with antialiasing
PLAIN = "SplatRenderMode: default"
DISCS = "SplatRenderMode: 2dgs"  # drawn along rays
MARKS = (MIP, PLAIN, DISCS)
METRES = "Metres per unit: "  # before the number


def mark(low_pass: LowPass) -> str:
    """Returns the comment that names the filter of a scene."""
    match low_pass:
        case Antialiasing():
            return MIP
        case AlongRays():
            return DISCS
        case Dilation():
            return PLAIN


def marked(gaussians: Gaussians, comments: Iterable[str]) -> Gaussians:
    """Returns a scene with the filter that the comments of its file name; as it is if they name none."""
    for line in comments:
        if line == MIP:
            return replace(gaussians, low_pass=Antialiasing())
        if line == DISCS:
            return replace(gaussians, low_pass=AlongRays())
    return gaussians


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
