"""Examines photos before training: which are blurred or repeated, and how their exposure differs."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from splatax.dataset import Dataset, Pixels, View, by_photo, photos_in
from splatax.inspection.blur import blurred
from splatax.inspection.detail import SHADES, SeenPoints, sampled_points, seen_points
from splatax.inspection.looks import LONGEST_SIDE, LUMINANCE, Look, in_time, joined, look_of
from splatax.io import images
from splatax.resampling import resize

LOOKING = 5.0  # seconds spent on photos
THUMBNAIL = (32, 24)  # pixels
SAME_PIXELS = 1.5  # root mean square difference of thumbnails, of 255, below which two photos may be one
SAME_PLACE = 0.01  # distance of their cameras, as a fraction of the extent
SAME_DIRECTION = 0.02  # and the angle between them, radians
FEW = 15  # photos up to which blurred ones stay: each shows something that no other does
LARGEST_FRACTION = 0.2  # of the training photos that may be left out as blurred
UNEVEN = 0.15  # stops: standard deviation of exposure from which compensating helps; see docs/cameras.md
FEWEST_SAMPLES = 30  # of a photo
ROUNDS = 10


@dataclass(frozen=True)
class Findings:
    """Findings about the photos of a capture.

    Attributes:
        blurred: training photos that are blurred, compared with the rest, and can be spared.
        kept: other training photos that are as blurred, but cannot be spared.
        repeated: training photos that show the same from the same place as another, with that one's name.
        exposure: standard deviation of the photos' exposure, in stops; None if it cannot be measured.
        seen: number of photos that were examined in the time.
        photos: number of photos that there were to examine.
    """

    blurred: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    repeated: dict[str, str] = field(default_factory=dict)
    exposure: float | None = None
    seen: int = 0
    photos: int = 0

    @property
    def uneven(self) -> bool:
        """True if exposure differs so much that compensating it improves the scene."""
        return self.exposure is not None and self.exposure >= UNEVEN


@dataclass(frozen=True)
class Sight:
    """A photo at small sizes.

    Attributes:
        view: its view.
        look: its sharpness, exposure and detail.
        thumbnail: luminance in [0, 255], at the size `THUMBNAIL`.
        samples: log2 of its luminance at sampled points; NaN where it does not see them.
    """

    view: View
    look: Look
    thumbnail: Float[np.ndarray, "h w"]
    samples: Float[np.ndarray, " n"]


def look_first(dataset: Dataset) -> Findings:
    """Examines small versions of the photos of a capture for a few seconds, evenly spread over all of them.

    Args:
        dataset: the capture. Photos without a file (`Survey.files`) are not looked at.

    Raises:
        DatasetError: if a photo is damaged, before hours of training end with that.
    """
    sights = list(sights_of(dataset, sampled_points(dataset), time.monotonic() + LOOKING))
    training = {view.name for view in dataset.train}
    spared, kept = blurred_of(sights, training)
    return Findings(
        spared,
        kept,
        repeated_photos(sights, repeated_of(sights, training, dataset.extent)),
        exposure_of([sight.samples for sight in sights]),
        photos_in(sight.view for sight in sights),
        photos_in(view for view in dataset.views if view.name in dataset.survey.files),
    )


def sights_of(dataset: Dataset, points: Float[np.ndarray, "n 3"], deadline: float) -> Iterator[Sight]:
    """Yields the photos that can be read before the deadline, sorted by name."""
    views = {view.name: view for view in dataset.views}

    def sight(name: str) -> Sight:
        return sight_of(views[name], images.glance(dataset.survey.files[name], LONGEST_SIDE), points)

    yield from in_time(views.keys() & dataset.survey.files.keys(), deadline, sight).values()


def sight_of(view: View, photo: Pixels, points: Float[np.ndarray, "n 3"]) -> Sight:
    """Returns the small versions of a decoded photo."""
    luminance = photo[..., :3].astype(np.float64) @ np.array(LUMINANCE)
    shades = np.repeat(np.round(luminance).astype(np.uint8)[..., None], 3, axis=2)
    thumbnail = resize(shades, *THUMBNAIL)[..., 0].astype(np.float64)
    height, width = luminance.shape
    seen = seen_points(points, view.camera, width, height)
    return Sight(view, look_of(photo, seen), thumbnail, shades_at(seen, luminance / 255))


def shades_at(seen: SeenPoints, luminance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " n"]:
    """Returns log2 of a photo's luminance at points; NaN where it does not see them, or is black or white."""
    shade = luminance[seen.rows, seen.columns]
    usable = (shade > SHADES[0]) & (shade < SHADES[1])
    samples = np.full(seen.total, np.nan)
    samples[seen.indices[usable]] = np.log2(shade[usable])
    return samples


def exposure_of(samples: Sequence[Float[np.ndarray, " n"]]) -> float | None:
    """Returns the standard deviation of the photos' exposure in stops; None if too few see the same points.

    A photo's exposure is the median, over the points that it sees, of how much brighter they are there than
    in the median photo.
    """
    shades = np.array([row for row in samples if np.isfinite(row).sum() >= FEWEST_SAMPLES])
    if len(shades) < 3:
        return None
    shades = shades[:, np.isfinite(shades).sum(axis=0) >= 2]
    shades = shades[np.isfinite(shades).sum(axis=1) >= FEWEST_SAMPLES]
    if len(shades) < 3 or not np.isfinite(shades).any(axis=0).all():
        return None
    exposures = np.zeros(len(shades))
    for _ in range(ROUNDS):
        usual = np.nanmedian(shades - exposures[:, None], axis=0)
        exposures = np.nanmedian(shades - usual, axis=1)
    return float(exposures.std())


def blurred_of(sights: Sequence[Sight], training: set[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the training photos that are blurred: those that can be spared, and the rest.

    Args:
        sights: of all views; a photo is compared with held-out ones too.
        training: names of the training views.
    """
    faces = by_photo((sight.view for sight in sights), {sight.view.name: sight.look for sight in sights})
    looks = {photo: each[0] if len(each) == 1 else joined(each) for photo, each in faces.items()}
    trained = {sight.view.photo for sight in sights if sight.view.name in training}
    found = [name for name in blurred(looks) if name in trained]
    spared = 0 if len(trained) <= FEW else int(LARGEST_FRACTION * len(trained))
    return tuple(sorted(found[:spared])), tuple(sorted(found[spared:]))


def repeated_of(sights: Sequence[Sight], training: set[str], extent: float) -> dict[str, str]:
    """Returns the training photos that repeat another photo, by name, with that one's name.

    A photo that repeats a held-out one is among them: it would make the score of that one meaningless.
    """
    repeated: dict[str, str] = {}
    kept = [sight for sight in sights if sight.view.name not in training]
    for sight in (sight for sight in sights if sight.view.name in training):
        same = next((other for other in kept if are_same(sight, other, extent)), None)
        if same is None:
            kept.append(sight)
        else:
            repeated[sight.view.name] = same.view.name
    return repeated


def repeated_photos(sights: Sequence[Sight], repeated: dict[str, str]) -> dict[str, str]:
    """Returns the photos that repeat others, by name: 360-degree photos of which all faces do.

    Args:
        sights: of all views.
        repeated: views that repeat another, by name, with that one's name.
    """
    photo_of = {sight.view.name: sight.view.photo for sight in sights}
    others = by_photo((sight.view for sight in sights), {name: repeated.get(name) for name in photo_of})
    return {photo: photo_of[each[0]] for photo, each in others.items() if each[0] and None not in each}


def are_same(one: Sight, other: Sight, extent: float) -> bool:
    """Returns whether two photos show the same from the same place."""
    a, b = one.view.camera, other.view.camera
    apart = float(np.linalg.norm(np.asarray(a.position) - np.asarray(b.position)))
    turned = float(np.linalg.norm(np.asarray(a.rotation)[2] - np.asarray(b.rotation)[2]))
    if apart > SAME_PLACE * extent or turned > SAME_DIRECTION:
        return False
    return float(np.sqrt(np.mean((one.thumbnail - other.thumbnail) ** 2))) < SAME_PIXELS
