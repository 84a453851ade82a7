"""Decides which photos are blurred, by their detail at points that other photos show too.

The sharpness of a whole photo depends on its content: that of a plain wall is low even if it is sharp. The
detail of the same points in several photos differs only by blur, and by the direction and the distance that
they are seen from.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from splatax.inspection.detail import Detail
from splatax.inspection.looks import Look
from splatax.inspection.outliers import FEWEST_TO_COMPARE, outliers

LEAST_DETAIL = 0.2  # standard deviation of log2 detail: blurred is below 0.62 times that of the other photos
LEAST_SHARPNESS = 0.4  # and of log sharpness of whole photos: below a quarter of that of the median photo
SIMILAR = np.log2(1.5)  # difference of log2 scale up to which two photos show a point alike
MOST_OTHERS = 32  # photos that a photo is compared with: those that show most of its points
FEWEST_OTHERS = 2  # photos that must show a point alike
FEWEST_SHARED = 30  # points at which a photo must be compared
FLAT = np.log2(3.0)  # log2 contrast, levels, below which a point shows rounding rather than detail
MEASURED = 0.5  # of the photos that must be comparable at points


def blurred(looks: Mapping[str, Look]) -> list[str]:
    """Returns the names of the photos that are blurred, compared with the others, the worst first.

    If at least half of the photos show enough of the same points, photos are compared at these, and one that
    shows too few of them is not called blurred. Otherwise the sharpness of whole photos is compared, with a
    larger tolerance. Photos that cannot be read are not called blurred.
    """
    looks = {name: look for name, look in looks.items() if not look.unreadable}
    ratios = relative_details(looks)
    names = [name for name, ratio in ratios.items() if np.isfinite(ratio)]
    if len(names) >= max(FEWEST_TO_COMPARE, MEASURED * len(looks)):
        return outliers(names, np.array([ratios[name] for name in names]), LEAST_DETAIL, -1)
    values = np.log([max(look.sharpness, 1e-3) for look in looks.values()])
    return outliers(list(looks), values, LEAST_SHARPNESS, -1)


def relative_details(looks: Mapping[str, Look]) -> dict[str, float]:
    """Returns log2 of each photo's detail, as a multiple of that of other photos at the same points, by name.

    It is NaN for photos that show too few points with detail, or too few that other photos show at a similar
    scale. A photo takes a few milliseconds, however many there are.
    """
    known = {name: look.detail for name, look in looks.items() if look.detail is not None}
    if not known:
        return dict.fromkeys(looks, np.nan)
    details = list(known.values())
    relative, scales = (
        np.array(rows) for rows in zip(*((d.relative, d.scales) for d in details), strict=True)
    )
    seen = np.isfinite(relative)
    shared = seen.astype(np.float32) @ seen.T.astype(np.float32)
    np.fill_diagonal(shared, 0)
    ratios = dict.fromkeys(looks, np.nan)
    for name, detail, own, count in zip(known, details, seen, shared, strict=True):
        others = np.argsort(-count, kind="stable")[:MOST_OTHERS]
        others = others[count[others] > 0]
        usual = usual_of(relative[others][:, own], scales[others][:, own], detail.scales[own])
        ratios[name] = ratio_of(detail, own, usual)
    return ratios


def usual_of(
    relative: Float[np.ndarray, "m k"], scales: Float[np.ndarray, "m k"], scale: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Returns the median contrast of points in the photos that show them at a similar scale; NaN if too few.

    Args:
        relative: contrasts of the points in other photos, log2; NaN where one does not show a point.
        scales: their scales there, log2.
        scale: scale at which the photo in question shows each point, log2.
    """
    with np.errstate(invalid="ignore"):
        ordered = np.sort(np.where(np.abs(scales - scale) <= SIMILAR, relative, np.nan), axis=0)  # NaN last
    count = np.isfinite(ordered).sum(axis=0)
    enough = count >= FEWEST_OTHERS
    usual, at = np.full(len(scale), np.nan), np.flatnonzero(enough)
    below, above = (count[at] - 1) // 2, count[at] // 2
    usual[at] = (ordered[below, at] + ordered[above, at]) / 2
    return usual


def ratio_of(detail: Detail, own: Bool[np.ndarray, " n"], usual: Float[np.ndarray, " k"]) -> float:
    """Returns log2 of a photo's detail as a multiple of the usual one; NaN if there are too few points.

    It is the median over the half with the most usual detail of the points that are not flat. A blurred photo
    differs most there, and neither rounding nor noise hides the difference.

    Args:
        detail: detail of the photo.
        own: which points it shows.
        usual: contrast of these in the other photos, log2.
    """
    expected = usual + detail.shades[own]  # levels, at the exposure of this photo
    counted = np.flatnonzero(expected >= FLAT)  # false for NaN
    if not len(counted):
        return np.nan
    counted = counted[expected[counted] >= np.median(expected[counted])]
    if len(counted) < FEWEST_SHARED:
        return np.nan
    return float(np.median(detail.relative[own][counted] - usual[counted]))
