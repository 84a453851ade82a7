"""The verdict on a scene in words: the good, the bad, and the probable causes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splatax.dataset import Dataset
from splatax.evaluation import ViewScore
from splatax.inspection.looks import look_of, robust_scores
from splatax.inspection.problems import LEAST_SHARPNESS, OUTLIER, TWICE
from splatax.io.datasets.photos import counted, listed
from splatax.report.next_photos import ISOLATED, Spot, spacing_of, spots_of
from splatax.runs.results import Comparison

GRADES = (  # least PSNR, dB, and how a picture of the scene then looks beside the photo
    (32.0, "nearly the same as the photo"),
    (27.0, "close to the photo, with small differences"),
    (22.0, "similar to the photo, but softer or with wrong details"),
    (-np.inf, "clearly different from the photo"),
)
GOOD, POOR = 27.0, 22.0  # dB from which a photo counts as matched, and below which as not
BEHIND = 3.0  # dB below the median photo from which a photo counts as bad
CORRECTABLE = 1.5  # dB that a colour correction gains
HAZE = 0.65  # of the contrast of the photo: a picture with less is hazy
CONCENTRATED, PART = 0.6, 0.05  # fraction of the squared error that lies in this fraction of the pixels
FEW = 20  # photos


@dataclass(frozen=True)
class Complaint:
    """One thing that is bad.

    Attributes:
        what: the fault.
        why: its probable cause, or the measurement that shows it.
        mend: what to do about it.
    """

    what: str
    why: str
    mend: str


@dataclass(frozen=True)
class Verdict:
    """The judgement of a scene in words.

    Attributes:
        headline: one sentence.
        good: sentences.
        bad: faults, the worst first.
        spots: where to take the next photos.
        matched: whether the scene matches a photo well, by name, for each that has a score.
    """

    headline: str
    good: tuple[str, ...]
    bad: tuple[Complaint, ...]
    spots: tuple[Spot, ...] = ()
    matched: dict[str, bool] = field(default_factory=dict)


def verdict_of(
    dataset: Dataset, comparisons: Sequence[Comparison], trial: Sequence[ViewScore] = ()
) -> Verdict | None:
    """Judges a run by its held-out photos, else by those of its trial run; None if it has no pictures.

    Args:
        dataset: the capture.
        comparisons: of the held-out views, or of training views where none are held out.
        trial: scores of photos that another run held out, for a run that holds out none.
    """
    scores = trial or [comparison.score for comparison in comparisons]
    unseen = bool(trial or dataset.test)
    if not scores:
        return None
    psnrs = np.array([score.psnr for score in scores])
    matched = {score.name: score.psnr >= _bar(psnrs) for score in scores}
    spots = spots_of(dataset, [name for name, good in matched.items() if not good])
    complaints = [
        *_unseen_photos(unseen),
        *_bad_photos(dataset, scores, () if trial else comparisons),  # the trial's pictures are not kept
        *_evenly_poor(psnrs),
        *_number(dataset),
        *(
            Complaint("There are gaps between the photos.", spot.why, spot.mend)
            for spot in spots[:1]
            if spot.gap
        ),
    ]
    good = tuple(_good(psnrs, scores, unseen))
    return Verdict(_headline(psnrs, unseen), good, tuple(complaints), tuple(spots), matched)


def grade(psnr: float) -> str:
    """Returns how a picture with this PSNR looks beside its photo."""
    return next(words for least, words in GRADES if psnr >= least)


def _bar(psnrs: np.ndarray) -> float:
    """Returns the PSNR below which a photo counts as bad."""
    return max(POOR, float(np.median(psnrs)) - BEHIND)


def _headline(psnrs: np.ndarray, unseen: bool) -> str:
    whose = "photos that it had not seen" if unseen else "its own photos"
    return f"Seen from the places of {whose}, the scene is {grade(float(np.median(psnrs)))}."


def _good(psnrs: np.ndarray, scores: Sequence[ViewScore], unseen: bool) -> list[str]:
    kind = "that it had not seen" if unseen else "that it was trained on"
    good, best = int((psnrs >= GOOD).sum()), max(scores, key=lambda score: score.psnr)
    if not good:
        return [f"The best picture, {best.name}, is {grade(best.psnr)}."]
    lines = [
        f"{good} of {counted(len(scores))} {kind} {'is' if good == 1 else 'are'} matched well; "
        f"best: {best.name}."
    ]
    if len(psnrs) > 2 and np.ptp(psnrs) < BEHIND:
        lines.append("The quality is even: no photo is much worse than the others.")
    return lines


def _unseen_photos(unseen: bool) -> list[Complaint]:
    if unseen:
        return []
    return [
        Complaint(
            "Nothing shows how the scene looks from other places.",
            "No photo was held out, so the scores are of photos that it was trained on.",
            "Train again with some photos held out (hold_out every:8).",
        )
    ]


def _bad_photos(
    dataset: Dataset, scores: Sequence[ViewScore], comparisons: Sequence[Comparison]
) -> list[Complaint]:
    """Returns a complaint for each cause, with the photos that suffer from it."""
    bar = _bar(np.array([score.psnr for score in scores]))
    shown = {comparison.score.name: comparison for comparison in comparisons}
    causes: dict[tuple[str, str], list[ViewScore]] = {}
    for score in sorted(scores, key=lambda score: score.psnr):
        if score.psnr < bar:
            causes.setdefault(_cause(dataset, score, scores, shown), []).append(score)
    complaints = []
    for (why, mend), bad in causes.items():
        verb = "is" if len(bad) == 1 else "are"
        complaints.append(
            Complaint(f"{listed(score.name for score in bad)} {verb} {grade(bad[0].psnr)}.", why, mend)
        )
    return complaints


def _cause(
    dataset: Dataset, score: ViewScore, scores: Sequence[ViewScore], shown: dict[str, Comparison]
) -> tuple[str, str]:
    """Returns the probable cause of a bad photo, and what to do about it."""
    errors = {name: float(np.median(values)) for name, values in dataset.survey.errors.items() if len(values)}
    if score.name in errors and errors[score.name] > max(
        TWICE * float(np.median(list(errors.values()))), 1.0
    ):
        return (
            "Poses: points project further from where this photo shows them than in the other photos.",
            "Leave it out, or find the cameras again: splatax reconstruct.",
        )
    bar = _bar(np.array([each.psnr for each in scores]))
    if score.corrected_psnr - score.psnr > CORRECTABLE and score.corrected_psnr >= bar:
        return (
            "Exposure: its brightness or white balance differs from the other photos.",
            "Lock exposure and white balance, or train with appearance exposure.",
        )
    if score.name in shown and _hazy(shown[score.name]):
        return (
            "Haze: something hangs in front of the camera there that no other photo shows to be empty.",
            "Take photos beside and behind this place, and train longer.",
        )
    if spacing_of(dataset, score.name) > ISOLATED:
        return (
            "Too few photos here: the nearest photos are further away than usual.",
            "Take two or three more photos around this place.",
        )
    if score.name in shown and _blurred(score.name, shown):
        return (
            "Motion: the photo itself is blurred, compared with the others.",
            "Take it again, or leave it out.",
        )
    if score.name in shown and _concentrated(shown[score.name]):
        return (
            "Most of the error is in one small part of the picture: something moved or shines there, or is "
            "in few photos.",
            "Mask what moved, or take more photos of that part.",
        )
    return (
        "The error is spread over the picture: fine detail is missing.",
        "Train longer, or take more photos from nearer.",
    )


def _blurred(name: str, shown: dict[str, Comparison]) -> bool:
    if len(shown) < 5:
        return False
    sharpness = np.log([max(look_of(each.photo).sharpness, 1e-3) for each in shown.values()])
    return bool(robust_scores(sharpness, LEAST_SHARPNESS)[list(shown).index(name)] < -OUTLIER)


def _hazy(comparison: Comparison) -> bool:
    counted_in = ... if comparison.mask is None else comparison.mask
    return float(comparison.image[counted_in].std()) < HAZE * float(comparison.photo[counted_in].std())


def _concentrated(comparison: Comparison) -> bool:
    difference = comparison.image.astype(np.float32) - comparison.photo
    errors = np.sort(
        np.sum(difference**2, axis=2)[... if comparison.mask is None else comparison.mask].ravel()
    )
    worst = errors[-max(round(PART * len(errors)), 1) :]
    return bool(worst.sum() > CONCENTRATED * errors.sum())


def _evenly_poor(psnrs: np.ndarray) -> list[Complaint]:
    if np.median(psnrs) >= GOOD or (psnrs < _bar(psnrs)).any():
        return []
    return [
        Complaint(
            "All pictures lack fine detail.",
            "No photo is much worse than the others, so the cause is not in single photos.",
            "Train longer, or take more and sharper photos from nearer.",
        )
    ]


def _number(dataset: Dataset) -> list[Complaint]:
    count = len(dataset.views)
    if count >= FEW:
        return []
    return [
        Complaint(
            f"There are only {counted(count)}.",
            "Each part of the scene should be in at least five of them.",
            "Take 50 to 200, around the subject at two or three heights.",
        )
    ]
