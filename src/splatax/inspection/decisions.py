"""Examines photos before training: which are blurred or repeated, and how their exposure differs."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera
from splatax.cameras.geometry import seen_at
from splatax.dataset import Dataset, Pixels, View, by_photo, photos_in
from splatax.inspection.looks import (
    LONGEST_SIDE,
    LUMINANCE,
    WORKERS,
    Look,
    look_of,
    robust_scores,
    spread,
)
from splatax.inspection.problems import FEWEST_TO_COMPARE, LEAST_SHARPNESS, OUTLIER
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
SAMPLES = 3000  # points at which photos are compared
SHADES = (0.04, 0.95)  # luminance outside of which a sample is noise or saturated
CELLS, SURFACE = 24, 1.1  # columns of the depth grid; how much deeper than the nearest point still is visible
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
        look: its sharpness and exposure.
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
    chosen = np.random.default_rng(0).permutation(len(dataset.points))[:SAMPLES]
    points = dataset.points.positions[chosen].astype(np.float64)
    sights = list(sights_of(dataset, points, time.monotonic() + LOOKING))
    training = {view.name for view in dataset.train}
    blurred, kept = blurred_of([sight for sight in sights if sight.view.name in training])
    return Findings(
        blurred,
        kept,
        repeated_photos(sights, repeated_of(sights, training, dataset.extent)),
        exposure_of([sight.samples for sight in sights]),
        photos_in(sight.view for sight in sights),
        photos_in(view for view in dataset.views if view.name in dataset.survey.files),
    )


def sights_of(dataset: Dataset, points: Float[np.ndarray, "n 3"], deadline: float) -> Iterator[Sight]:
    """Yields the photos that can be read before the deadline, sorted by name."""
    views = {view.name: view for view in dataset.views}

    def sight_in_time(name: str) -> Sight | None:
        if time.monotonic() >= deadline:
            return None
        return sight_of(views[name], images.glance(dataset.survey.files[name], LONGEST_SIDE), points)

    names = list(spread(sorted(views.keys() & dataset.survey.files.keys())))
    with ThreadPoolExecutor(WORKERS) as pool:
        found = dict(zip(names, pool.map(sight_in_time, names), strict=True))
    for name in sorted(found):
        if (sight := found[name]) is not None:
            yield sight


def sight_of(view: View, photo: Pixels, points: Float[np.ndarray, "n 3"]) -> Sight:
    """Returns the small versions of a decoded photo."""
    luminance = photo[..., :3].astype(np.float64) @ np.array(LUMINANCE)
    shades = np.repeat(np.round(luminance).astype(np.uint8)[..., None], 3, axis=2)
    thumbnail = resize(shades, *THUMBNAIL)[..., 0].astype(np.float64)
    height, width = luminance.shape
    upright = abs(width * view.camera.height / view.camera.width - height) <= 0.05 * height
    samples = shades_at(points, view.camera, luminance / 255) if upright else np.full(len(points), np.nan)
    return Sight(view, look_of(photo), thumbnail, samples)


def shades_at(
    points: Float[np.ndarray, "n 3"], camera: Camera, luminance: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, " n"]:
    """Returns log2 of a photo's luminance at points; NaN where it does not see them, or is black or white."""
    height, width = luminance.shape
    pixels, depth = seen_at(camera, points)
    x, y = (pixels * [width / camera.width, height / camera.height]).T
    inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))  # false for NaN
    row, column, depth = y[inside].astype(int), x[inside].astype(int), depth[inside]
    cell = (row * CELLS // width) * CELLS + column * CELLS // width
    nearest = np.full(cell.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    shade = luminance[row, column]
    seen = (depth <= SURFACE * nearest[cell]) & (shade > SHADES[0]) & (shade < SHADES[1])
    samples = np.full(len(points), np.nan)
    samples[inside[seen]] = np.log2(shade[seen])
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


def blurred_of(sights: Sequence[Sight]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the photos that are much less sharp than the others: those that can be spared, and the rest."""
    # A face of a 360-degree photo may show nothing but a ceiling: its sharpness is the mean of its faces.
    looks = by_photo((s.view for s in sights), {s.view.name: s.look.sharpness for s in sights})
    if len(looks) < FEWEST_TO_COMPARE:
        return (), ()
    names, sharpness = list(looks), np.log([max(float(np.mean(each)), 1e-3) for each in looks.values()])
    scores = robust_scores(sharpness, LEAST_SHARPNESS)
    found = [names[i] for i in np.argsort(scores) if scores[i] < -OUTLIER]
    spared = 0 if len(looks) <= FEW else int(LARGEST_FRACTION * len(names))
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
