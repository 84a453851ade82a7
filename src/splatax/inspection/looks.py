"""Measures the exposure, the sharpness and the detail of photos, from small versions of them."""

import io
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from splatax.dataset import Pixels, View
from splatax.errors import InputError
from splatax.inspection.detail import Detail, SeenPoints, detail_at, joined_detail, seen_points
from splatax.io import images

LONGEST_SIDE = 1000  # pixels of the size at which sharpness is measured
THUMBNAIL_SIDE = 240  # pixels
WORKERS = 4
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of encoded RGB (Rec. 709)
CLIPPED = 250  # level, of 255, from which a pixel counts as white
Measured = TypeVar("Measured")


@dataclass(frozen=True)
class Look:
    """Exposure, sharpness and detail of one photo.

    Attributes:
        luminance: mean luminance, in [0, 1].
        clipped: fraction of pixels that are white.
        sharpness: variance of the Laplacian of luminance in [0, 255].
        thumbnail: the photo as a small JPEG; empty if it was not asked for.
        unreadable: reason why the photo could not be decoded; empty if it could.
        detail: its detail at the sampled points of the capture; None if it was not asked for.
    """

    luminance: float = 0.0
    clipped: float = 0.0
    sharpness: float = 0.0
    thumbnail: bytes = b""
    unreadable: str = ""
    detail: Detail | None = field(default=None, repr=False, compare=False)


def looks_of(
    paths: Mapping[str, Path],
    seconds: float,
    views: Mapping[str, View] | None = None,
    points: Float[np.ndarray, "n 3"] | None = None,
) -> dict[str, Look]:
    """Measures photos, spread evenly over all of them, until the time is up.

    Args:
        paths: paths of the photos, by name.
        seconds: time limit.
        views: views of the photos, by name; None for photos without poses.
        points: world points at which the detail of views is measured; None if there are none.
    """

    def measured(name: str) -> Look:
        return look(paths[name], views.get(name) if views else None, points)

    return in_time(paths, time.monotonic() + seconds, measured)


def in_time(
    names: Iterable[str], deadline: float, measured: Callable[[str], Measured]
) -> dict[str, Measured]:
    """Returns measurements by name, sorted, of as many photos as are measured before the deadline.

    The photos are spread evenly over all of them.

    Args:
        names: names of the photos.
        deadline: time of the monotonic clock after which no measurement begins.
        measured: measures the photo of a name.
    """

    def measured_in_time(name: str) -> Measured | None:
        return measured(name) if time.monotonic() < deadline else None

    order = list(spread(sorted(names)))
    with ThreadPoolExecutor(WORKERS) as pool:
        found = zip(order, pool.map(measured_in_time, order), strict=True)
        return {name: seen for name, seen in sorted(found, key=lambda each: each[0]) if seen is not None}


def spread(names: list[str]) -> Iterable[str]:
    """Returns all names in an order whose prefixes are spread evenly: every 16th, then those between."""
    for step_and_start in ((16, 0), (16, 8), (8, 4), (4, 2), (2, 1)):
        step, start = step_and_start
        yield from names[start::step]


def look(path: Path, view: View | None = None, points: Float[np.ndarray, "n 3"] | None = None) -> Look:
    """Measures one photo and makes a thumbnail of it. A JPEG is decoded no larger than needed.

    Args:
        path: path of the photo.
        view: its view; None if its pose is not known.
        points: world points at which its detail is measured.
    """
    try:
        photo = images.glance(path, LONGEST_SIDE)
        height, width = photo.shape[:2]
        seen = None if view is None or points is None else seen_points(points, view.camera, width, height)
        return replace(look_of(photo, seen), thumbnail=thumbnail(photo))
    except (InputError, OSError) as error:
        return Look(unreadable=str(error))


def joined(faces: Sequence[Look]) -> Look:
    """Returns the look of a 360-degree photo from those of its faces, with their thumbnails in two rows."""
    from PIL import Image

    readable = [face for face in faces if not face.unreadable]
    if len(readable) < len(faces):
        return next(face for face in faces if face.unreadable)
    pictures = [Image.open(io.BytesIO(face.thumbnail)) for face in readable if face.thumbnail]
    columns, side = -(-len(pictures) // 2), THUMBNAIL_SIDE // 2
    sheet = Image.new("RGB", (max(columns, 1) * side, 2 * side))
    for number, picture in enumerate(pictures):
        sheet.paste(picture.resize((side, side)), (number % columns * side, number // columns * side))
    luminance, clipped, sharp = np.mean([(f.luminance, f.clipped, f.sharpness) for f in readable], axis=0)
    small = thumbnail(np.asarray(sheet)) if pictures else b""
    details = [face.detail for face in readable if face.detail is not None]
    detail = joined_detail(details) if details else None
    return Look(float(luminance), float(clipped), float(sharp), small, detail=detail)


def thumbnail(pixels: Pixels) -> bytes:
    """Returns a small JPEG of a photo, for pages. Transparency becomes white."""
    from PIL import Image

    image = Image.fromarray(pixels)
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.BOX)
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB")
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=80)
    return buffer.getvalue()


def look_of(photo: Pixels, seen: SeenPoints | None = None) -> Look:
    """Measures the pixels of one photo.

    Args:
        photo: the pixels.
        seen: points of the capture that it shows; None if they are not known.
    """
    pixels = photo.astype(np.float32)
    luminance = pixels[..., :3] @ np.array(LUMINANCE, np.float32)
    opaque = pixels[..., 3] > 0 if pixels.shape[2] == 4 else np.ones(luminance.shape, bool)
    if not opaque.any() or min(luminance.shape) < 3:
        return Look()
    white = (pixels[..., :3].min(axis=2) >= CLIPPED) & opaque
    laplacian = laplacian_of(luminance)
    return Look(
        float(luminance[opaque].mean()) / 255,
        float(white.sum() / opaque.sum()),
        float(laplacian.var()),
        detail=None if seen is None else detail_at(seen, luminance, laplacian),
    )


def laplacian_of(luminance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h-2 w-2"]:
    """Returns the Laplacian of a photo, without the pixels at the border."""
    g = luminance
    return 4 * g[1:-1, 1:-1] - g[:-2, 1:-1] - g[2:, 1:-1] - g[1:-1, :-2] - g[1:-1, 2:]
