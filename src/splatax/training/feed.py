"""Batches of training: the training views in random order, read ahead and sent to the device."""

import math
from collections.abc import Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count, islice

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, UInt8

from splatax.cameras import Camera
from splatax.dataset import Mask, Pixels, View
from splatax.training.photo_cache import PhotoCache
from splatax.training.protocols import ResolutionSchedule, Source
from splatax.training.resolution import Resolution

FIRST = Source(np.int32(0), np.int32(0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """One training view, on the device.

    Attributes:
        camera: of the size of the photo.
        photo: 8-bit RGB or RGBA.
        mask: true where a pixel counts; None if all do.
        source: indices of the view and of its lens.
        divisor: factor by which the photo was downscaled (static).
    """

    camera: Camera
    photo: UInt8[Array, "h w c"]
    mask: Bool[Array, "h w"] | None = None
    source: Source = FIRST
    divisor: int = field(default=1, metadata={"static": True})


def batches(
    views: Sequence[View],
    seed: int,
    start: int = 0,
    resolution: ResolutionSchedule = Resolution(),
    room: int | float = math.inf,
) -> Iterator[Batch]:
    """Yields all views in random order, then again in another order, without end.

    Each view is read in a thread while the caller trains on the view before.

    Args:
        views: the training views, at least one.
        seed: of the order.
        start: number of batches to skip; the batches that follow do not depend on it.
        resolution: size of the photos at each step; the first batch is for step 1. It may change between
            batches: a photo that was read ahead at another size is read again.
        room: bytes of memory for decoded photos.
    """
    cache = PhotoCache(views, room)
    origin = sources(views)
    indices = islice(order(len(views), seed, start // len(views)), start % len(views), None)
    sizes = [(view.camera.width, view.camera.height) for view in views]
    with ThreadPoolExecutor(1) as reader:
        ahead: tuple[int, Future[tuple[Camera, Pixels, Mask | None]]] | None = None
        index = next(indices)
        for step in count(start + 1):
            divisor = resolution.divisor(step, sizes[index])
            if ahead is None or ahead[0] != divisor:
                ahead = divisor, reader.submit(cache.frame, index, divisor)
            frame, here = ahead[1].result(), (origin[index], divisor)
            index = next(indices)
            divisor = resolution.divisor(step + 1, sizes[index])
            ahead = divisor, reader.submit(cache.frame, index, divisor)
            yield batch(*frame, *here)


def batch(camera: Camera, photo: Pixels, mask: Mask | None, source: Source, divisor: int) -> Batch:
    """Copies a view to the device."""
    return Batch(camera, jnp.asarray(photo), None if mask is None else jnp.asarray(mask), source, divisor)


def sources(views: Sequence[View]) -> list[Source]:
    """Returns the source of each view. Two photos have the same lens if all but their poses is equal."""
    lenses: dict[Hashable, int] = {}
    found = []
    for index, view in enumerate(views):
        camera = view.camera
        numbers, kind = jax.tree.flatten((camera.focal, camera.center, camera.lens))
        key = (kind, camera.width, camera.height, *(np.asarray(number).tobytes() for number in numbers))
        found.append(Source(np.int32(index), np.int32(lenses.setdefault(key, len(lenses)))))
    return found


def order(views: int, seed: int, epoch: int) -> Iterator[int]:
    """Yields indices of views from an epoch on.

    The order of an epoch depends only on its number and the seed.
    """
    for number in count(epoch):
        yield from np.random.default_rng((seed, number)).permutation(views).tolist()
