"""The views of a run as they are scored one after another, and the pictures of the worst for its report."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatax.dataset import View, by_photo
from splatax.evaluation import ViewScore, scores_of
from splatax.inspection.looks import LUMINANCE, sharpness
from splatax.report.pictures import data_uri, error_map
from splatax.runs.history import Picture, shrunk
from splatax.runs.results import Comparison

MOST = 40  # views with pictures
ROOM = 20_000_000  # bytes of all pictures, at most, so that a report stays below 30 MB
HAZE = 0.65  # of the contrast of the photo: a picture with less is hazy
CONCENTRATED, PART = 0.6, 0.05  # fraction of the squared error that lies in this fraction of the pixels


@dataclass(frozen=True)
class Exhibit:
    """A view as a report shows it.

    Attributes:
        score: its score.
        masked: true if it has a mask.
        photo: the photo, as a data URI; so are the other pictures.
        image: the scene from there.
        error: map of their difference.
        hazy: true if the scene has much less contrast than the photo.
        concentrated: true if most of the error lies in a small part of the picture.
    """

    score: ViewScore
    masked: bool
    photo: str
    image: str
    error: str
    hazy: bool
    concentrated: bool

    @property
    def size(self) -> int:
        """Bytes of its pictures."""
        return len(self.photo) + len(self.image) + len(self.error)


class Gallery:
    """The views of a run, of which only the worst and the best keep their pictures.

    Attributes:
        scores: of all views, in the order in which they were seen.
        sharpness: logarithm of the sharpness of each photo, by name.
        best: the view with the highest PSNR; None before there are two.
    """

    def __init__(self, most: int = MOST, room: int = ROOM):
        """Creates an empty gallery for pictures of `most` views, which may take `room` bytes together."""
        self.scores: list[ViewScore] = []
        self.sharpness: dict[str, float] = {}
        self.best: Exhibit | None = None
        self._most, self._room = most, room
        self._worst: list[tuple[float, int, Exhibit]] = []  # a heap: the best of the worst comes first

    def see(self, comparison: Comparison) -> None:
        """Notes the score of a view, and keeps its pictures if it is among the worst until now."""
        score, number = comparison.score, len(self.scores)
        self.scores.append(score)
        luminance = shrunk(comparison.photo).astype(np.float32) @ np.array(LUMINANCE, np.float32)
        flat = min(luminance.shape) < 3
        self.sharpness[score.name] = float(np.log(max(0.0 if flat else sharpness(luminance), 1e-3)))
        rank = -score.psnr, -number
        bad = len(self._worst) < self._most or rank > self._worst[0][:2]
        good = self.best is None or score.psnr >= self.best.score.psnr
        if not (bad or good):
            return
        exhibit = exhibited(comparison)
        if good:
            self.best = exhibit
        if bad:
            heapq.heappush(self._worst, (*rank, exhibit))
            if len(self._worst) > self._most:
                heapq.heappop(self._worst)

    def join_faces(self, views: Sequence[View]) -> None:
        """Replaces the scores of the faces of a 360-degree photo by its own, once all views have been seen.

        Pictures stay those of faces.

        Args:
            views: all views of the capture.
        """
        self.scores = list(scores_of(views, self.scores).views)
        looks = by_photo(views, self.sharpness)
        self.sharpness = {photo: float(np.mean(each)) for photo, each in looks.items()}

    @property
    def worst(self) -> list[Exhibit]:
        """The worst views, the worst first: as many as there is room for."""
        shown: list[Exhibit] = []
        size = 0
        for *_, exhibit in sorted(self._worst, key=lambda each: each[:2], reverse=True):
            size += exhibit.size
            if shown and size > self._room:
                break
            shown.append(exhibit)
        return shown


def exhibited(comparison: Comparison) -> Exhibit:
    """Returns a view with its pictures as a report shows them."""
    return Exhibit(
        comparison.score,
        comparison.mask is not None,
        data_uri(comparison.photo),
        data_uri(comparison.image),
        data_uri(error_map(comparison.image, comparison.photo, comparison.mask)),
        _hazy(comparison),
        _concentrated(comparison),
    )


def _hazy(comparison: Comparison) -> bool:
    def contrast(picture: Picture) -> float:
        return float(picture[... if comparison.mask is None else comparison.mask].std())

    return contrast(comparison.image) < HAZE * contrast(comparison.photo)


def _concentrated(comparison: Comparison) -> bool:
    difference = comparison.image.astype(np.float32) - comparison.photo
    errors = np.sum(difference**2, axis=2)[... if comparison.mask is None else comparison.mask].ravel()
    first = len(errors) - max(round(PART * len(errors)), 1)
    worst = np.partition(errors, first)[first:]
    return bool(worst.sum() > CONCENTRATED * errors.sum())
