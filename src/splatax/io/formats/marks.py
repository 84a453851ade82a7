"""Comments in scene files that say how a scene was trained, and how large it is."""

import math
from collections.abc import Iterable
from dataclasses import replace

from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays, Antialiasing, Dilation, LowPass

MIP = "SplatRenderMode: mip"  # trained with antialiasing
PLAIN = "SplatRenderMode: default"
DISCS = "SplatRenderMode: 2dgs"  # drawn along rays
KINDS: dict[str, type[Dilation] | type[Antialiasing] | type[AlongRays]] = {
    MIP: Antialiasing,
    PLAIN: Dilation,
    DISCS: AlongRays,
}
MARKS = tuple(KINDS)
VARIANCE = "Low-pass variance: "  # before the number, pixels^2
METRES = "Metres per unit: "  # before the number


def marks_of(low_pass: LowPass) -> tuple[str, ...]:
    """Returns the comments that tell the filter of a scene: its kind, and its variance if not the default."""
    match low_pass:
        case Antialiasing():
            kind = MIP
        case AlongRays():
            kind = DISCS
        case Dilation():
            kind = PLAIN
    if low_pass.variance == type(low_pass)().variance:
        return (kind,)
    return kind, f"{VARIANCE}{float(low_pass.variance)!r}"


def is_mark(line: str) -> bool:
    """Returns whether a comment tells the filter of a scene."""
    return line in MARKS or line.startswith(VARIANCE)


def marked(gaussians: Gaussians, comments: Iterable[str]) -> Gaussians:
    """Returns a scene with the filter that the comments of its file tell; as it is if they tell none.

    Raises:
        ValueError: if the variance is not a number of at least zero.
    """
    low_pass = gaussians.low_pass
    for line in sorted(filter(is_mark, comments), key=lambda line: line not in KINDS):  # kinds come first
        if line in KINDS:
            low_pass = low_pass if line == PLAIN else KINDS[line]()  # PLAIN is also said of discs
        else:
            low_pass = replace(low_pass, variance=_variance(line.removeprefix(VARIANCE)))
    return replace(gaussians, low_pass=low_pass)


def _variance(text: str) -> float:
    variance = float(text)
    if not 0 <= variance < math.inf:
        raise ValueError(f"a filter cannot have a variance of {text}")
    return variance


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
