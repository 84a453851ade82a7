"""The photos that a scene matches badly, grouped by the probable cause."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from splatax.dataset import Dataset, by_photo
from splatax.evaluation import ViewScore
from splatax.inspection.blur import blurred
from splatax.inspection.examination import looks_at
from splatax.inspection.problems import TWICE
from splatax.report.gallery import Judged, Symptoms
from splatax.report.next_photos import ISOLATED, spacings

CORRECTABLE = 1.5  # dB that a colour correction gains


@dataclass(frozen=True)
class Cause:
    """The probable cause of bad scores.

    Attributes:
        why: one sentence; empty if nothing is known.
        fix: advice to the user.
    """

    why: str
    fix: str


UNKNOWN = Cause("", "Compare these photos with the pictures in the report of the run that held them out.")


@dataclass(frozen=True)
class _Known:
    """What is known about the photos of a run.

    Attributes:
        dataset: the capture.
        bar: PSNR below which a photo counts as bad, dB.
        errors: median reprojection error by name, pixels, for photos that have one.
        spacings: distance to the nearest training photo by name, in multiples of the usual distance.
        symptoms: of photos by name, for those that have pictures.
        hasty: see `Judged`.
    """

    dataset: Dataset
    bar: float
    errors: Mapping[str, float]
    spacings: Mapping[str, float]
    symptoms: Mapping[str, Symptoms]
    hasty: int

    @cached_property
    def largest_error(self) -> float:
        """Reprojection error, pixels, above which a pose counts as wrong."""
        return max(TWICE * float(np.median(list(self.errors.values()))), 1.0) if self.errors else np.inf

    @cached_property
    def blurred(self) -> set[str]:
        """Names of the photos that are blurred, compared with the others. Looks at them for some seconds."""
        return set(blurred(looks_at(self.dataset)))


def by_cause(dataset: Dataset, judged: Judged, bar: float) -> dict[Cause, list[ViewScore]]:
    """Returns the photos with a PSNR below `bar` by the cause of it, the worst photo first.

    Args:
        dataset: the capture.
        judged: the photos with scores.
        bar: PSNR from which a photo counts as good, dB.
    """
    bad = sorted((score for score in judged.scores if score.psnr < bar), key=lambda score: score.psnr)
    if not bad:
        return {}
    errors = {name: values for name, values in dataset.survey.errors.items() if len(values)}
    known = _Known(
        dataset,
        bar,
        {
            name: float(np.median(np.concatenate(values)))
            for name, values in by_photo(dataset.views, errors).items()
        },
        spacings(dataset),
        judged.symptoms,
        judged.hasty,
    )
    causes: dict[Cause, list[ViewScore]] = {}
    for score in bad:
        causes.setdefault(_cause(score, known), []).append(score)
    return causes


def _cause(score: ViewScore, known: _Known) -> Cause:
    """Returns the probable cause of a bad photo, and what to do about it."""
    symptoms = known.symptoms.get(score.name)
    if known.errors.get(score.name, 0.0) > known.largest_error:
        return Cause(
            "Poses: points project further from where this photo shows them than in the other photos.",
            "Leave it out, or find the cameras again: splatax reconstruct.",
        )
    if score.corrected_psnr - score.psnr > CORRECTABLE and score.corrected_psnr >= known.bar:
        return Cause(
            "Exposure: its brightness or white balance differs from the other photos.",
            "Lock exposure and white balance, or train with appearance exposure.",
        )
    if symptoms and symptoms.hazy:
        return Cause(
            "Haze: Gaussians float in front of the camera, where no other photo shows that space is empty.",
            "Take photos beside and behind this place, and train longer.",
        )
    if known.spacings.get(score.name, 1.0) > ISOLATED:
        return Cause(
            "Too few photos here: the nearest photos are further away than usual.",
            "Take two or three more photos around this place.",
        )
    if score.name in known.blurred:
        return Cause(
            "Motion: the photo itself is blurred, compared with the others.",
            "Take it again, or leave it out.",
        )
    if symptoms is None:
        return UNKNOWN
    if symptoms.concentrated:
        return Cause(
            "Most of the error is in one small part of the picture: something moved or shines there, or is "
            "in few photos.",
            "Mask what moved, or take more photos of that part.",
        )
    if known.hasty:
        return Cause(
            f"The run that held it out made only {known.hasty} steps, too few for fine detail.",
            "Give the command more time.",
        )
    return Cause(
        "The error is spread over the picture: fine detail is missing.",
        "Train longer, or take more photos from nearer.",
    )
