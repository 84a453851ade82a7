"""The verdict on a scene in words: the good, the bad, and the probable causes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from splatax.dataset import Dataset, photos_in
from splatax.evaluation import ViewScore
from splatax.io.datasets.photos import counted, listed
from splatax.report.causes import by_cause
from splatax.report.gallery import Judged
from splatax.report.next_photos import Spot, spots_of

GRADES = (  # least PSNR, dB, and how a picture of the scene then looks beside the photo
    (32.0, "nearly the same as the photo"),
    (27.0, "close to the photo, with small differences"),
    (22.0, "similar to the photo, but softer or with wrong details"),
    (-np.inf, "clearly different from the photo"),
)
GOOD, POOR = 27.0, 22.0  # dB from which a photo counts as matched, and below which as not
BEHIND = 3.0  # dB below the median photo from which a photo counts as bad
FEW = 20  # photos
EXPOSURE = (
    "The exposure of the photos differs. The scene has that of a typical photo, so a picture of it may be "
    "brighter or darker than the photo beside it; that does not count here."
)


@dataclass(frozen=True)
class Complaint:
    """One thing that is bad.

    Attributes:
        what: the fault.
        why: its probable cause, or the measurement that shows it; empty if none is known.
        fix: advice to the user.
        photo: name of the worst of the photos that it is about; empty if it is about the whole capture.
    """

    what: str
    why: str
    fix: str
    photo: str = ""


@dataclass(frozen=True)
class Verdict:
    """The judgement of a scene in words.

    Attributes:
        headline: one sentence.
        good: sentences.
        bad: faults, the worst first.
        spots: places for the next photos.
        matched: whether the scene matches a photo well, by name, for each that has a score.
        remark: a sentence on what the comparison leaves out; empty if it leaves out nothing.
    """

    headline: str
    good: tuple[str, ...]
    bad: tuple[Complaint, ...]
    spots: tuple[Spot, ...] = ()
    matched: dict[str, bool] = field(default_factory=dict)
    remark: str = ""


def verdict_of(
    dataset: Dataset,
    judged: Judged,
    unseen: bool,
    doubted: Mapping[str, float] = MappingProxyType({}),
) -> Verdict | None:
    """Judges a scene by some photos; None if there are none.

    Args:
        dataset: the capture.
        judged: the photos with scores: held-out ones, or training photos where none are held out.
        unseen: true if they were held out, by this run or by its trial run.
        doubted: weights of the training photos that counted less than others, by name.
    """
    scores = judged.scores
    if not scores:
        return None
    psnrs = np.array([score.psnr for score in scores])
    matched = {score.name: score.psnr >= _bar(psnrs) for score in scores}
    spots = spots_of(dataset, [name for name, good in matched.items() if not good])
    complaints = [
        *_unseen_photos(unseen),
        *_doubted(doubted),
        *_bad_photos(dataset, judged, _bar(psnrs)),
        *_evenly_poor(psnrs),
        *_number(dataset),
        *(
            Complaint("There are gaps between the photos.", spot.why, spot.fix)
            for spot in spots[:1]
            if spot.gap
        ),
    ]
    good = tuple(_good(psnrs, scores, unseen))
    remark = EXPOSURE if judged.corrected else ""
    return Verdict(
        _headline(psnrs, unseen, judged.scene), good, tuple(complaints), tuple(spots), matched, remark
    )


def grade(psnr: float) -> str:
    """Returns how a picture with this PSNR looks beside its photo."""
    return next(words for least, words in GRADES if psnr >= least)


def _bar(psnrs: np.ndarray) -> float:
    """Returns the PSNR below which a photo counts as bad."""
    return max(POOR, float(np.median(psnrs)) - BEHIND)


def _headline(psnrs: np.ndarray, unseen: bool, scene: str) -> str:
    whose = "photos that it was not trained on" if unseen else "its training photos"
    return f"From the viewpoints of {whose}, {scene} is {grade(float(np.median(psnrs)))}."


def _good(psnrs: np.ndarray, scores: Sequence[ViewScore], unseen: bool) -> list[str]:
    kind = "that it was not trained on" if unseen else "that it was trained on"
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


def _bad_photos(dataset: Dataset, judged: Judged, bar: float) -> list[Complaint]:
    """Returns a complaint for each cause, with the photos that suffer from it."""
    complaints = []
    for cause, bad in by_cause(dataset, judged, bar).items():
        verb = "is" if len(bad) == 1 else "are"
        what = f"{listed(score.name for score in bad)} {verb} {grade(bad[0].psnr)}."
        complaints.append(Complaint(what, cause.why, cause.fix, bad[0].name))
    return complaints


def _evenly_poor(psnrs: np.ndarray) -> list[Complaint]:
    if np.median(psnrs) >= GOOD or (psnrs < _bar(psnrs)).any():
        return []
    return [
        Complaint(
            "No photo is matched well.",
            "None is much worse than the others, so the cause is not in single photos.",
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
