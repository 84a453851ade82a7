"""The views of a run as they are scored one after another, and the pictures of the worst for its report."""

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from splatax.dataset import View, by_photo
from splatax.evaluation import ViewScore, scores_of
from splatax.report.pictures import data_uri, error_map
from splatax.runs.history import Picture
from splatax.runs.results import Comparison

MOST = 40  # views with pictures
ROOM = 20_000_000  # bytes of all pictures, at most, so that a report stays below 30 MB
HAZE = 0.65  # of the contrast of the photo: a picture with less is hazy
CONCENTRATED, PART = 0.6, 0.05  # fraction of the squared error that lies in this fraction of the pixels


@dataclass(frozen=True)
class Symptoms:
    """Properties of a picture of the scene, compared with its photo, by which a bad score is explained.

    Attributes:
        hazy: true if the scene has much less contrast than the photo.
        concentrated: true if most of the error lies in a small part of the picture.
    """

    hazy: bool
    concentrated: bool


@dataclass(frozen=True)
class Exhibit:
    """A view as a report shows it.

    Attributes:
        score: its score.
        masked: true if it has a mask.
        photo: the photo, as a data URI; so are the other pictures.
        image: the scene from there.
        error: map of their difference.
    """

    score: ViewScore
    masked: bool
    photo: str
    image: str
    error: str

    @property
    def size(self) -> int:
        """Bytes of its pictures."""
        return len(self.photo) + len(self.image) + len(self.error)


@dataclass(frozen=True)
class Judged:
    """The photos by which a scene is judged.

    Attributes:
        scores: of each photo.
        symptoms: of photos by name, where they are known; there may be some of photos without a score.
        pictures: the worst view of photos with pictures, by name of the photo, the worst first.
        best: the view with the highest PSNR; None if it is not known, or is the only one.
        kind: what the photos are, in words.
        scene: what the pictures show beside the photos, in words.
        corrected: true if each PSNR of the scores is the colour-corrected one.
        hasty: number of steps of the run, if they were too few to show fine detail; else 0.
    """

    scores: Sequence[ViewScore]
    symptoms: Mapping[str, Symptoms] = field(default_factory=dict)
    pictures: Mapping[str, Exhibit] = field(default_factory=dict)
    best: Exhibit | None = None
    kind: str = "photos"
    scene: str = "the scene"
    corrected: bool = False
    hasty: int = 0


class Gallery:
    """The views of a run, of which only the worst and the best keep their pictures.

    Attributes:
        scores: of all views, in the order in which they were seen.
        symptoms: of all views, by name.
        best: the view with the highest PSNR; None before the first.
    """

    def __init__(self, most: int = MOST, room: int = ROOM):
        """Creates an empty gallery for pictures of `most` views, which may take `room` bytes together."""
        self.scores: list[ViewScore] = []
        self.symptoms: dict[str, Symptoms] = {}
        self.best: Exhibit | None = None
        self._most, self._room = most, room
        self._worst: list[tuple[float, int, Exhibit]] = []  # a heap: the best of the worst comes first
        self._photos: dict[str, str] = {}  # of faces, by the name of the view

    def see(self, comparison: Comparison) -> None:
        """Notes the score of a view, and keeps its pictures if it is among the worst until now."""
        score, number = comparison.score, len(self.scores)
        self.scores.append(score)
        self.symptoms[score.name] = symptoms_of(comparison)
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

        Pictures stay those of faces. The photo has the symptoms of its worst face.

        Args:
            views: all views of the capture.
        """
        self._photos = {view.name: view.photo for view in views if view.photo != view.name}
        psnr = {score.name: score.psnr for score in self.scores}
        self.scores = list(scores_of(views, self.scores).views)
        seen = {name: name for name in self.symptoms}
        self.symptoms = {
            photo: self.symptoms[min(faces, key=psnr.__getitem__)]
            for photo, faces in by_photo(views, seen).items()
        }

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

    @property
    def judged(self) -> Judged:
        """The photos seen until now, with the pictures that there are of them."""
        pictures: dict[str, Exhibit] = {}
        for each in self.worst:
            pictures.setdefault(self._photos.get(each.score.name, each.score.name), each)
        best = self.best if len(self.scores) > 1 else None
        return Judged(tuple(self.scores), dict(self.symptoms), pictures, best)


def exhibited(comparison: Comparison) -> Exhibit:
    """Returns a view with its pictures as a report shows them."""
    return Exhibit(
        comparison.score,
        comparison.mask is not None,
        data_uri(comparison.photo),
        data_uri(comparison.image),
        data_uri(error_map(comparison.image, comparison.photo, comparison.mask)),
    )


def symptoms_of(comparison: Comparison) -> Symptoms:
    """Returns the properties of a view that may explain its score."""
    return Symptoms(_hazy(comparison), _concentrated(comparison))


def _hazy(comparison: Comparison) -> bool:
    def contrast(picture: Picture) -> float:
        counted = picture[... if comparison.mask is None else comparison.mask]
        return float(counted.std() / max(counted.mean(), 1.0))  # a shorter exposure does not change it

    return contrast(comparison.image) < HAZE * contrast(comparison.photo)


def _concentrated(comparison: Comparison) -> bool:
    difference = comparison.image.astype(np.float32) - comparison.photo
    errors = np.sum(difference**2, axis=2)[... if comparison.mask is None else comparison.mask].ravel()
    first = len(errors) - max(round(PART * len(errors)), 1)
    worst = np.partition(errors, first)[first:]
    return bool(worst.sum() > CONCENTRATED * errors.sum())
