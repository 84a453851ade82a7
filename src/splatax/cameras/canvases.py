"""Canvases: a few image sizes that stand for the many sizes of a capture's photos.

A compiled program has one image size. A photo on a canvas that is larger shares its program with others; see
`Camera.on_canvas`.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from splatax.cameras.camera import Camera

Size = tuple[int, int]  # width, height, pixels
MOST_SIZES = 64  # that are compared with each other; more are first rounded up to a coarser grid


def canvases_for(cameras: Sequence[Camera], most: int) -> list[Size | None]:
    """Returns the canvas of each camera, so that there are at most `most` image sizes; None for its own size.

    If the cameras have no more sizes than that, none needs a canvas. Otherwise canvases cover photos of
    similar sizes, with few pixels that are not used. Cameras whose image repeats sideways keep their sizes,
    and do not count.

    Args:
        cameras: of the photos.
        most: number of canvases, at least 1.
    """
    own = [(camera.width, camera.height) if camera.lens.PERIOD is None else None for camera in cameras]
    counts = Counter(size for size in own if size is not None)
    if len(counts) <= most:
        return [None] * len(own)
    canvas_of = _merged(counts, most)
    return [None if size is None else canvas_of[size] for size in own]


def _merged(counts: Counter[Size], most: int) -> dict[Size, Size]:
    """Returns the canvas of each size.

    Every size begins with its own; then the two that add the fewest pixels together become one, and so on.
    """
    step, groups = 1, {size: [size] for size in counts}
    while len(groups) > max(MOST_SIZES, most):
        step, groups = 2 * step, {}
        for width, height in counts:
            groups.setdefault((-(-width // step), -(-height // step)), []).append((width, height))
    members = list(groups.values())
    sizes = np.array([np.max(group, axis=0) for group in members])
    photos = np.array([sum(counts[size] for size in group) for group in members])
    while len(sizes) > most:
        first, second = _cheapest(sizes, photos)
        sizes[first] = np.maximum(sizes[first], sizes[second])
        photos[first] += photos[second]
        members[first] += members.pop(second)
        sizes, photos = np.delete(sizes, second, axis=0), np.delete(photos, second)
    return {
        size: (int(width), int(height))
        for group, (width, height) in zip(members, sizes, strict=True)
        for size in group
    }


def _cheapest(sizes: Int[np.ndarray, "m 2"], photos: Int[np.ndarray, " m"]) -> tuple[int, int]:
    """Returns the two canvases, in order, that need the fewest more pixels as one."""
    together = np.maximum(sizes[:, None], sizes[None]).prod(axis=2)
    pixels = sizes.prod(axis=1)
    added = (together - pixels[:, None]) * photos[:, None] + (together - pixels[None]) * photos[None]
    rows, columns = np.triu_indices(len(sizes), 1)
    best = int(np.argmin(added[rows, columns]))
    return int(rows[best]), int(columns[best])
