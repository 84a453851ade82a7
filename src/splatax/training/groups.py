"""The views of training steps that use several: groups of photos of one size, in random order, read ahead."""

import math
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count, islice

import jax
import numpy as np
from jaxtyping import Float

from splatax.ahead import cores
from splatax.cameras import Camera
from splatax.dataset import Pixels, View
from splatax.training.comparison import Views
from splatax.training.devices import Sharding
from splatax.training.feed import READERS, landmarks_of, order, sources
from splatax.training.photo_cache import Frame, PhotoCache, with_alpha
from splatax.training.protocols import ResolutionSchedule, Source
from splatax.training.recipes import Recipe


@dataclass(frozen=True)
class PendingStep:
    """A step whose photos are being read."""

    group: list[int]
    divisor: int
    frames: list[Future[Frame]]  # of the views that this process draws
    views: Future[Views]  # on the devices

    def cancel(self) -> None:
        """Reads no photo whose reading has not begun."""
        for frame in self.frames:
            frame.cancel()


@dataclass(frozen=True)
class Reader:
    """Reads the photos of steps in threads, and sends them to the devices.

    Attributes:
        photos: decodes the photos of the training views.
        sources: of the training views.
        landmarks: of the training views; None if the loss does not use them.
        sharding: the devices.
        here: which views of a step the devices of this process draw.
        size: views of a step.
        decoders: threads that decode photos.
        sender: the thread that sends them.
    """

    photos: PhotoCache
    sources: list[Source]
    landmarks: Float[np.ndarray, "views k 3"] | None
    sharding: Sharding
    here: range
    size: int
    decoders: Executor
    sender: Executor

    def start(self, group: list[int], divisor: int) -> PendingStep:
        """Starts to read the photos of a step, shrunk by the divisor."""
        frames = [self.decoders.submit(self.photos.frame, group[place], divisor) for place in self.here]
        return PendingStep(group, divisor, frames, self.sender.submit(self._sent, group, divisor, frames))

    def _sent(self, group: list[int], divisor: int, frames: list[Future[Frame]]) -> Views:
        cameras = [self.photos.camera(index, divisor) for index in group]
        read = [frame.result() for frame in frames]
        views = _on_devices(cameras, [self.sources[index] for index in group], read, divisor, self.sharding)
        if self.landmarks is None:
            return views
        own = self.landmarks[[group[place] for place in self.here]]
        return replace(views, landmarks=self.sharding.views(own, self.size))


def steps_of(
    views: Sequence[View],
    recipe: Recipe,
    start: int,
    resolution: ResolutionSchedule,
    sharding: Sharding,
    photos: PhotoCache | None = None,
) -> Iterator[Views]:
    """Yields the views of each step, without end; the next ones are read while the caller trains.

    A process reads only the photos that its own devices draw, in as many threads as it has cores. They read
    ahead by one step, or by as many as give each thread a photo.

    Args:
        views: the training views, at least one.
        recipe: the settings.
        start: number of steps to skip; what follows does not depend on it.
        resolution: size of the photos at each step. It may change between steps: views that were read ahead
            at another size are read again.
        sharding: the devices.
        photos: decodes the photos of the views; None for a cache with room for all of them.
    """
    cache, size, here = photos or PhotoCache(views, math.inf), recipe.views, sharding.drawn_here(recipe.views)
    landmarks = landmarks_of(views) if recipe.objective.geometry.outputs else None
    threads = min(cores(), READERS)
    most_ahead = -(-threads // max(len(here), 1))  # steps
    kinds = [cache.kind(index) for index in range(len(views))]
    groups = islice(grouped(kinds, size, recipe.seed), start, None)

    def divisor_at(step: int, group: list[int]) -> int:
        camera = views[group[0]].camera
        return resolution.divisor(step, (camera.width, camera.height))

    with ThreadPoolExecutor(threads) as decoders, ThreadPoolExecutor(1) as sender:
        reader = Reader(cache, sources(views), landmarks, sharding, here, size, decoders, sender)
        pending: deque[PendingStep] = deque()
        try:
            for step in count(start + 1):
                for later in range(step + len(pending), step + most_ahead + 1):
                    group = next(groups)
                    pending.append(reader.start(group, divisor_at(later, group)))
                now = pending.popleft()
                if now.divisor != (wanted := divisor_at(step, now.group)):
                    now.cancel()
                    now = reader.start(now.group, wanted)
                yield now.views.result()
        finally:
            for unused in pending:
                unused.cancel()


def grouped(kinds: Sequence[Hashable], size: int, seed: int) -> Iterator[list[int]]:
    """Yields groups of indices whose kinds are equal, without end.

    Views come in the random order of `feed.order`; those of a kind that do not fill a group wait for the next
    epoch. A kind with fewer views than a group has the same view in it more than once.
    """
    waiting: dict[Hashable, list[int]] = {}
    for index in order(len(kinds), seed, 0):
        group = waiting.setdefault(kinds[index], [])
        group.append(index)
        if len(group) == size:
            yield waiting.pop(kinds[index])


def _on_devices(
    cameras: list[Camera], sources: list[Source], frames: list[Frame], divisor: int, sharding: Sharding
) -> Views:
    """Sends the views of a step to the devices."""
    camera, source = (
        jax.tree.map(
            lambda *leaves: sharding.everywhere(np.stack([np.asarray(leaf) for leaf in leaves])), *trees
        )
        for trees in (cameras, sources)
    )
    masks = [mask for _, _, mask in frames if mask is not None]
    return Views(
        camera,
        sharding.views(np.stack(_alike([photo for _, photo, _ in frames])), len(cameras)),
        sharding.views(np.stack(masks), len(cameras)) if masks else None,
        source,
        divisor=divisor,
    )


def _alike(photos: list[Pixels]) -> list[Pixels]:
    """Returns photos with the same channels: opaque ones get alpha if others of the step may have it.

    A process does not know the photos of the others. Alpha of 255 changes no bit of the loss.
    """
    if len({photo.shape[2] for photo in photos}) == 1 and jax.process_count() == 1:
        return photos
    return [with_alpha(photo) for photo in photos]
