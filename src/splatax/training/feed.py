"""Training views in random order, as batches for the device."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count, islice

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, UInt8

from splatax.camera import Camera
from splatax.dataset import Mask, Pixels, View
from splatax.training.photo_cache import PhotoCache
from splatax.training.protocols import ResolutionSchedule, Source
from splatax.training.resolution import Resolution

FIRST = Source(np.int32(0), np.int32(0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """One view: its camera, its photo as 8-bit RGB or RGBA, which pixels count (None: all), which of the
    training views it is, and by what its size was divided."""

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
    """All views in a new random order, again and again, each read while the one before is learned from.

    Args:
        views: at least one.
        seed: of the order.
        start: how many batches to leave out; the rest are the same as without.
        resolution: of each step; the first batch is for step 1.
        room: for decoded photos, bytes.
    """
    cache = PhotoCache(views, room)
    origin = sources(views)
    indices = islice(order(len(views), seed, start // len(views)), start % len(views), None)
    sizes = [(view.camera.width, view.camera.height) for view in views]
    wanted = (
        (index, resolution.divisor(step, sizes[index])) for step, index in enumerate(indices, start + 1)
    )
    with ThreadPoolExecutor(1) as reader:
        index, divisor = next(wanted)
        coming = reader.submit(cache.frame, index, divisor)
        while True:
            frame, here = coming.result(), (origin[index], divisor)
            index, divisor = next(wanted)
            coming = reader.submit(cache.frame, index, divisor)
            yield batch(*frame, *here)


def batch(camera: Camera, photo: Pixels, mask: Mask | None, source: Source, divisor: int) -> Batch:
    """A view on the device."""
    return Batch(camera, jnp.asarray(photo), None if mask is None else jnp.asarray(mask), source, divisor)


def sources(views: Sequence[View]) -> list[Source]:
    """Of each view. Photos share a lens if their cameras have the same intrinsics and size."""
    lenses: dict[tuple[float, ...], int] = {}
    found = []
    for index, view in enumerate(views):
        camera = view.camera
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        lens = lenses.setdefault(tuple(float(number) for number in numbers), len(lenses))
        found.append(Source(np.int32(index), np.int32(lens)))
    return found


def order(views: int, seed: int, epoch: int) -> Iterator[int]:
    """Indices of views from an epoch on: each epoch's order depends on the seed and its number alone."""
    for number in count(epoch):
        yield from np.random.default_rng((seed, number)).permutation(views).tolist()
