"""The verdict on a scene in words: the good, the bad, and the probable causes."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np

from splatax.dataset import Dataset, by_photo, photos_in
from splatax.evaluation import ViewScore
from splatax.inspection.looks import robust_scores
from splatax.inspection.problems import LEAST_SHARPNESS, OUTLIER, TWICE
from splatax.io.datasets.photos import counted, listed
from splatax.report.gallery import Exhibit, Gallery
from splatax.report.next_photos import ISOLATED, Spot, spacings, spots_of

GRADES = (  # least PSNR, dB, and how a picture of the scene then looks beside the photo
    (32.0, "nearly the same as the photo"),
    (27.0, "close to the photo, with small differences"),
    (22.0, "similar to the photo, but softer or with wrong details"),
    (-np.inf, "clearly different from the photo"),
)
GOOD, POOR = 27.0, 22.0  # dB from which a photo counts as matched, and below which as not
BEHIND = 3.0  # dB below the median photo from which a photo counts as bad
CORRECTABLE = 1.5  # dB that a colour correction gains
FEW = 20  # photos


@dataclass(frozen=True)
class Complaint:
    """One thing that is bad.

    Attributes:
        what: the fault.
        why: its probable cause, or the measurement that shows it.
        fix: advice to the user.
    """

    what: str
    why: str
    fix: str


@dataclass(frozen=True)
class Verdict:
    """The judgement of a scene in words.

    Attributes:
        headline: one sentence.
        good: sentences.
        bad: faults, the worst first.
        spots: places for the next photos.
        matched: whether the scene matches a photo well, by name, for each that has a score.
    """

    headline: str
    good: tuple[str, ...]
    bad: tuple[Complaint, ...]
    spots: tuple[Spot, ...] = ()
    matched: dict[str, bool] = field(default_factory=dict)


def verdict_of(
    dataset: Dataset,
    gallery: Gallery,
    trial: Sequence[ViewScore] = (),
    doubted: Mapping[str, float] = MappingProxyType({}),
) -> Verdict | None:
    """Judges a run by its held-out photos, else by those of its trial run; None if it has no pictures.

    Args:
        dataset: the capture.
        gallery: the held-out views, or training views where none are held out.
        trial: scores of photos that another run held out, for a run that holds out none.
        doubted: weights of the training photos that counted less than others, by name.
    """
    scores = trial or gallery.scores
    unseen = bool(trial or dataset.test)
    if not scores:
        return None
    psnrs = np.array([score.psnr for score in scores])
    matched = {score.name: score.psnr >= _bar(psnrs) for score in scores}
    spots = spots_of(dataset, [name for name, good in matched.items() if not good])
    complaints = [
        *_unseen_photos(unseen),
        *_doubted(doubted),
        *_bad_photos(dataset, scores, Gallery() if trial else gallery),  # the trial's pictures are not kept
        *_evenly_poor(psnrs),
        *_number(dataset),
        *(
            Complaint("There are gaps between the photos.", spot.why, spot.fix)
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
    whose = "held-out photos" if unseen else "its training photos"
    return f"From the viewpoints of {whose}, the scene is {grade(float(np.median(psnrs)))}."


def _good(psnrs: np.ndarray, scores: Sequence[ViewScore], unseen: bool) -> list[str]:
    kind = "held out from training" if unseen else "that it was trained on"
    good, best = int((psnrs >= GOOD).sum()), max(scores, key=lambda score: score.psnr)
    if not good:
        return [f"The best picture of a photo {kind}, {best.name}, is {grade(best.psnr)}."]
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
            "Nothing shows how the scene looks from other viewpoints.",
            "No photo was held out, so the scores are of photos that it was trained on.",
            "Train again with some photos held out (hold_out every:8).",
        )
    ]


def _doubted(weights: Mapping[str, float]) -> list[Complaint]:
    if not weights:
        return []
    verb = "does" if len(weights) == 1 else "do"
    return [
        Complaint(
            f"{listed(sorted(weights, key=weights.__getitem__))} {verb} not fit the other photos.",
            "The loss stayed far above that of the other photos during training, so the weight was lowered: "
            f"to {min(weights.values()):.2g} at the end, where 1 is usual.",
            "Check whether the pose is wrong or something stood in front of the camera; if so, leave it "
            "out. If the photo is right, weigh all photos equally (photo_weights equal).",
        )
    ]


@dataclass(frozen=True)
class _Known:
    """What is known about the photos of a run.

    Attributes:
        bar: PSNR below which a photo counts as bad, dB.
        errors: median reprojection error by name, pixels, for photos that have one.
        spacings: distance to the nearest training photo by name, in multiples of the usual distance.
        shown: the worst views, by name.
        blurred: names of photos that are blurred, compared with the others.
    """

    bar: float
    errors: Mapping[str, float]
    spacings: Mapping[str, float]
    shown: Mapping[str, Exhibit]
    blurred: Set[str]

    @cached_property
    def largest_error(self) -> float:
        """Reprojection error, pixels, above which a pose counts as wrong."""
        return max(TWICE * float(np.median(list(self.errors.values()))), 1.0) if self.errors else np.inf


def _bad_photos(dataset: Dataset, scores: Sequence[ViewScore], gallery: Gallery) -> list[Complaint]:
    """Returns a complaint for each cause, with the photos that suffer from it."""
    bar = _bar(np.array([score.psnr for score in scores]))
    worst_first = [score for score in sorted(scores, key=lambda score: score.psnr) if score.psnr < bar]
    if not worst_first:
        return []
    photo_of = {view.name: view.photo for view in dataset.views}
    errors = {name: values for name, values in dataset.survey.errors.items() if len(values)}
    known = _Known(
        bar,
        {
            name: float(np.median(np.concatenate(values)))
            for name, values in by_photo(dataset.views, errors).items()
        },
        spacings(dataset),
        {photo_of.get(each.score.name, each.score.name): each for each in reversed(gallery.worst)},
        _blurred(gallery.sharpness),
    )
    causes: dict[tuple[str, str], list[ViewScore]] = {}
    for score in worst_first:
        causes.setdefault(_cause(score, known), []).append(score)
    complaints = []
    for (why, fix), bad in causes.items():
        verb = "is" if len(bad) == 1 else "are"
        complaints.append(
            Complaint(f"{listed(score.name for score in bad)} {verb} {grade(bad[0].psnr)}.", why, fix)
        )
    return complaints


def _cause(score: ViewScore, known: _Known) -> tuple[str, str]:
    """Returns the probable cause of a bad photo, and what to do about it."""
    shown = known.shown.get(score.name)
    if known.errors.get(score.name, 0.0) > known.largest_error:
        return (
            "Poses: points project further from where this photo shows them than in the other photos.",
            "Leave it out, or find the cameras again: splatax reconstruct.",
        )
    if score.corrected_psnr - score.psnr > CORRECTABLE and score.corrected_psnr >= known.bar:
        return (
            "Exposure: its brightness or white balance differs from the other photos.",
            "Lock exposure and white balance, or train with appearance exposure.",
        )
    if shown and shown.hazy:
        return (
            "Haze: Gaussians float in front of the camera, where no other photo shows that space is empty.",
            "Take photos beside and behind this place, and train longer.",
        )
    if known.spacings.get(score.name, 1.0) > ISOLATED:
        return (
            "Too few photos here: the nearest photos are further away than usual.",
            "Take two or three more photos around this place.",
        )
    if score.name in known.blurred:
        return (
            "Motion: the photo itself is blurred, compared with the others.",
            "Take it again, or leave it out.",
        )
    if shown and shown.concentrated:
        return (
            "Most of the error is in one small part of the picture: something moved or shines there, or is "
            "in few photos.",
            "Mask what moved, or take more photos of that part.",
        )
    return (
        "The error is spread over the picture: fine detail is missing.",
        "Train longer, or take more photos from nearer.",
    )


def _blurred(sharpness: Mapping[str, float]) -> set[str]:
    """Returns the names of photos that are blurred, compared with the others, if there are enough others."""
    if len(sharpness) < 5:
        return set()
    scores = robust_scores(np.array(list(sharpness.values())), LEAST_SHARPNESS)
    return {name for name, score in zip(sharpness, scores, strict=True) if score < -OUTLIER}


def _evenly_poor(psnrs: np.ndarray) -> list[Complaint]:
    if np.median(psnrs) >= GOOD or (psnrs < _bar(psnrs)).any():
        return []
    return [
        Complaint(
            "All views lack fine detail.",
            "No photo is much worse than the others, so the cause is not in single photos.",
            "Train longer, or take more and sharper photos from nearer.",
        )
    ]


def _number(dataset: Dataset) -> list[Complaint]:
    count = photos_in(dataset.views)
    if count >= FEW:
        return []
    return [
        Complaint(
            f"There are only {counted(count)}.",
            "Each part of the scene should be in at least five of them.",
            "Take more from other viewpoints, so that each hidden surface is seen in some photos."
            if any(view.face_of for view in dataset.views)
            else "Take 50 to 200, around the subject at two or three heights.",
        )
    ]
