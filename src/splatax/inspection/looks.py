"""Measures the exposure and the sharpness of photos, from small versions of them."""

import io
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatax.dataset import Pixels
from splatax.errors import InputError
from splatax.io import images
from splatax.math.robust import MAD_TO_SIGMA

LONGEST_SIDE = 1000  # pixels of the size at which sharpness is measured
THUMBNAIL_SIDE = 240  # pixels
WORKERS = 4
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of encoded RGB (Rec. 709)
CLIPPED = 250  # level, of 255, from which a pixel counts as white


@dataclass(frozen=True)
class Look:
    """Exposure and sharpness of one photo.

    Attributes:
        luminance: mean luminance, in [0, 1].
        clipped: fraction of pixels that are white.
        sharpness: variance of the Laplacian of luminance in [0, 255].
        thumbnail: the photo as a small JPEG; empty if it was not asked for.
        unreadable: reason why the photo could not be decoded; empty if it could.
    """

    luminance: float = 0.0
    clipped: float = 0.0
    sharpness: float = 0.0
    thumbnail: bytes = b""
    unreadable: str = ""


def looks_of(paths: dict[str, Path], seconds: float) -> dict[str, Look]:
    """Measures photos, spread evenly over all of them, until the time is up.

    Args:
        paths: paths of the photos, by name.
        seconds: time limit.
    """
    deadline = time.monotonic() + seconds

    def look_in_time(name: str) -> Look | None:
        return look(paths[name]) if time.monotonic() < deadline else None

    names = list(spread(sorted(paths)))
    with ThreadPoolExecutor(WORKERS) as pool:
        found = zip(names, pool.map(look_in_time, names), strict=True)
        return {name: seen for name, seen in sorted(found) if seen is not None}


def spread(names: list[str]) -> Iterable[str]:
    """Returns all names in an order whose prefixes are spread evenly: every 16th, then those between."""
    for step_and_start in ((16, 0), (16, 8), (8, 4), (4, 2), (2, 1)):
        step, start = step_and_start
        yield from names[start::step]


def look(path: Path) -> Look:
    """Measures one photo and makes a thumbnail of it. A JPEG is decoded no larger than needed."""
    try:
        photo = images.glance(path, LONGEST_SIDE)
        return replace(look_of(photo), thumbnail=thumbnail(photo))
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
    return Look(float(luminance), float(clipped), float(sharp), small)


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


def look_of(photo: Pixels) -> Look:
    """Measures the pixels of one photo."""
    pixels = photo.astype(np.float32)
    luminance = pixels[..., :3] @ np.array(LUMINANCE, np.float32)
    opaque = pixels[..., 3] > 0 if pixels.shape[2] == 4 else np.ones(luminance.shape, bool)
    if not opaque.any() or min(luminance.shape) < 3:
        return Look()
    white = (pixels[..., :3].min(axis=2) >= CLIPPED) & opaque
    return Look(
        float(luminance[opaque].mean()) / 255,
        float(white.sum() / opaque.sum()),
        sharpness(luminance),
    )


def sharpness(luminance: Float[np.ndarray, "h w"]) -> float:
    """Returns the variance of the Laplacian (Pech-Pacheco et al. 2000)."""
    g = luminance
    laplacian = 4 * g[1:-1, 1:-1] - g[:-2, 1:-1] - g[2:, 1:-1] - g[1:-1, :-2] - g[1:-1, 2:]
    return float(laplacian.var())


def robust_scores(values: Float[np.ndarray, " n"], floor: float) -> Float[np.ndarray, " n"]:
    """Returns distances from the median, in standard deviations estimated by the median deviation.

    Args:
        values: measurements in any unit.
        floor: lower bound of the standard deviation, so that nearly equal photos have no outliers.
    """
    middle = np.median(values)
    sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(values - middle))), floor)
    return (values - middle) / sigma
