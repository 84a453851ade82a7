"""Batches of training: the training views in random order, read ahead and sent to the device."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count, islice

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from splatax.ahead import cores
from splatax.cameras import Camera
from splatax.cameras.rig import numbers_of_lenses
from splatax.dataset import Mask, Pixels, View
from splatax.gaussians import Gaussians
from splatax.pytrees import pytree
from splatax.training.photo_cache import Frame, PhotoCache
from splatax.training.protocols import ResolutionSchedule, Source
from splatax.training.resolution import Resolution

MOST_LANDMARKS = 8192  # of one photo; more cost time and memory, and say little more
READERS = 16  # threads that read photos, at most
FIRST = Source(np.int32(0), np.int32(0))


@pytree
@dataclass(frozen=True)
class Batch:
    """One training view, on the device.

    Attributes:
        camera: of the size of the photo, or on its canvas.
        photo: 8-bit RGB or RGBA; zero beyond the camera's frame, if it has one.
        mask: true where a pixel counts; None if all do.
        source: indices of the view and of its lens.
        divisor: factor by which the photo was downscaled (static).
        landmarks: world points that the photo shows, padded with NaN; None if they are not asked for.
        context: Gaussians that the photo shows too and that are not learned; None if there are none.
        fraction: part of the whole scene's Gaussians that are learned, for means over all; None for all.
    """

    camera: Camera
    photo: UInt8[Array, "h w c"]
    mask: Bool[Array, "h w"] | None = None
    source: Source = FIRST
    divisor: int = field(default=1, metadata={"static": True})
    landmarks: Float[Array, "k 3"] | None = None
    context: Gaussians | None = None
    fraction: Float[Array, ""] | None = None


def batches(
    views: Sequence[View],
    seed: int,
    start: int = 0,
    resolution: ResolutionSchedule = Resolution(),
    photos: PhotoCache | None = None,
    landmarks: bool = False,
) -> Iterator[Batch]:
    """Yields all views in random order, then again in another order, without end.

    The next views are read in threads while the caller trains on the views before, as many at a time as the
    process has cores. The order and the contents of batches do not depend on the threads.

    Args:
        views: the training views, at least one.
        seed: of the order.
        start: number of batches to skip; the batches that follow do not depend on it.
        resolution: size of the photos at each step; the first batch is for step 1. It may change between
            batches: a photo that was read ahead at another size is read again.
        photos: decodes the photos of the views; None for a cache with room for all of them.
        landmarks: whether batches have those of their views, if any view has some.
    """
    cache = photos or PhotoCache(views, math.inf)
    origin = sources(views)
    known = landmarks_of(views) if landmarks else None
    indices = islice(order(len(views), seed, start // len(views)), start % len(views), None)
    sizes = [(view.camera.width, view.camera.height) for view in views]
    readers = min(cores(), READERS)
    with ThreadPoolExecutor(readers) as pool:
        ahead: deque[tuple[int, int, Future[Frame]]] = deque()  # index of a view, divisor, and its frame

        def read(index: int, divisor: int) -> tuple[int, int, Future[Frame]]:
            return index, divisor, pool.submit(cache.frame, index, divisor)

        try:
            for step in count(start + 1):
                for later in range(step + len(ahead), step + readers + 1):
                    index = next(indices)
                    ahead.append(read(index, resolution.divisor(later, sizes[index])))
                index, divisor, frame = ahead.popleft()
                if divisor != (wanted := resolution.divisor(step, sizes[index])):
                    frame.cancel()
                    _, divisor, frame = read(index, wanted)
                points = None if known is None else known[index]
                yield batch(*frame.result(), origin[index], divisor, points)
        finally:
            for *_, frame in ahead:
                frame.cancel()


def batch(
    camera: Camera,
    photo: Pixels,
    mask: Mask | None,
    source: Source,
    divisor: int,
    landmarks: Float[np.ndarray, "k 3"] | None = None,
) -> Batch:
    """Copies a view to the device."""
    counted, known = (None if rows is None else jnp.asarray(rows) for rows in (mask, landmarks))
    return Batch(camera, jnp.asarray(photo), counted, source, divisor, known)


def landmarks_of(views: Sequence[View]) -> Float[np.ndarray, "views k 3"] | None:
    """Returns the landmarks of all views, evenly thinned to `MOST_LANDMARKS` and padded with NaN, or None."""
    each = [np.zeros((0, 3)) if view.landmarks is None else view.landmarks() for view in views]
    each = [rows[:: max(1, -(-len(rows) // MOST_LANDMARKS))] for rows in each]
    most = max(map(len, each))
    if not most:
        return None
    padded = np.full((len(views), most, 3), np.nan, np.float32)
    for row, rows in zip(padded, each, strict=True):
        row[: len(rows)] = rows
    return padded


def sources(views: Sequence[View]) -> list[Source]:
    """Returns the source of each view. Two photos have the same lens if all but their poses is equal.

    Faces of a 360-degree photo are one photo: they share its exposure and the corrections of its pose.
    """
    lenses = numbers_of_lenses([view.camera for view in views])
    photos: dict[str, int] = {}
    found = []
    for view, lens in zip(views, lenses, strict=True):
        pixel = 1 / np.mean(np.asarray(view.camera.focal, np.float64))
        place = np.asarray(view.camera.position, np.float32)
        photo = np.int32(photos.setdefault(view.photo, len(photos)))
        found.append(Source(photo, np.int32(lens), np.float32(pixel), place))
    return found


def rows_for(views: Sequence[View]) -> int:
    """Returns the number of rows of tables that have one for each photo, or for each lens."""
    return max(int(max(source.view, source.lens)) for source in sources(views)) + 1


def order(views: int, seed: int, epoch: int) -> Iterator[int]:
    """Yields indices of views from an epoch on.

    The order of an epoch depends only on its number and the seed.
    """
    for number in count(epoch):
        yield from np.random.default_rng((seed, number)).permutation(views).tolist()
