"""Comments in scene files that say how a scene is drawn, and how large it is."""

import math
from collections.abc import Iterable
from dataclasses import replace

from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays, Antialiasing, Dilation, LowPass
from splatax.order import Order

MIP = "SplatRenderMode: mip"  # trained with antialiasing
PLAIN = "SplatRenderMode: default"
DISCS = "SplatRenderMode: 2dgs"  # drawn along rays
BY_DISTANCE = "SplatSortingMethod: cameraDistance"  # the word of KHR_gaussian_splatting; depth if none
KINDS: dict[str, type[Dilation] | type[Antialiasing] | type[AlongRays]] = {
    MIP: Antialiasing,
    PLAIN: Dilation,
    DISCS: AlongRays,
}
MARKS = (*KINDS, BY_DISTANCE)
VARIANCE = "Low-pass variance: "  # before the number, pixels^2
METRES = "Metres per unit: "  # before the number


def marks_of(low_pass: LowPass, order: Order) -> tuple[str, ...]:
    """Returns the comments that tell how a scene is drawn.

    They tell the kind of its filter, the variance if it is not the default, and the order by distance.
    """
    match low_pass:
        case Antialiasing():
            kind = MIP
        case AlongRays():
            kind = DISCS
        case Dilation():
            kind = PLAIN
    usual = low_pass.variance == type(low_pass)().variance
    variance = () if usual else (f"{VARIANCE}{float(low_pass.variance)!r}",)
    return (kind, *variance, *((BY_DISTANCE,) if order == "distance" else ()))


def is_mark(line: str) -> bool:
    """Returns whether a comment tells how a scene is drawn."""
    return line in MARKS or line.startswith(VARIANCE)


def marked(gaussians: Gaussians, comments: Iterable[str]) -> Gaussians:
    """Returns a scene with the filter and the order that the comments of its file tell.

    Raises:
        ValueError: if the variance is not a number of at least zero.
    """
    low_pass, order = gaussians.low_pass, gaussians.order
    for line in sorted(filter(is_mark, comments), key=lambda line: line not in KINDS):  # kinds come first
        if line == BY_DISTANCE:
            order = "distance"
        elif line in KINDS:
            low_pass = low_pass if line == PLAIN else KINDS[line]()  # PLAIN is also said of discs
        else:
            low_pass = replace(low_pass, variance=_variance(line.removeprefix(VARIANCE)))
    return replace(gaussians, low_pass=low_pass, order=order)


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
