"""Several runs of one capture side by side: numbers, curves and pictures, in one HTML file."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter

from splatax.dataset import Mask
from splatax.report.curves import psnr_over_time
from splatax.report.gallery import MOST, ROOM
from splatax.report.page import fill
from splatax.report.pictures import data_uri
from splatax.runs.history import Picture

COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
CROP_FRACTION = 1 / 5  # of the shorter side of a picture
CROP_SHOWN = 360  # pixels that a crop is enlarged to, at least
COLUMNS = 3  # of the faces of a 360-degree photo in one picture

Scalar = TypeVar("Scalar", bound=np.generic)  # of pictures or masks


@dataclass(frozen=True)
class Row:
    """One quantity of all runs, in words; `best` marks the best where that means something."""

    label: str
    cells: tuple[str, ...]
    best: tuple[bool, ...]


@dataclass(frozen=True)
class Curve:
    """Test PSNR, dB, at seconds of training."""

    seconds: tuple[float, ...]
    psnr: tuple[float, ...]


@dataclass(frozen=True)
class Lineup:
    """A test photo, what each run shows from there, and the PSNR of each, dB.

    The pictures of a 360-degree photo have all of its faces, see `joined`.
    """

    name: str
    photo: Picture
    images: tuple[Picture, ...]
    psnr: tuple[float, ...]
    mask: Mask | None = None


def side_by_side(
    names: Sequence[str],
    rows: Sequence[Row],
    curves: Sequence[Curve],
    psnrs: Mapping[str, Sequence[float]],
    lineup: Callable[[str], Lineup],
) -> str:
    """Returns a page that shows runs side by side.

    Pictures are shown of the test views with the largest differences in PSNR, `MOST` of them at most. The
    others are in a table.

    Args:
        names: of the runs; all that follows is in their order.
        rows: of the table.
        curves: of each run.
        psnrs: of each test view, dB, by its name.
        lineup: returns a test view by its name; called only for views that are shown, one at a time.
    """
    colors = [COLORS[i % len(COLORS)] for i in range(len(names))]
    ordered = sorted(psnrs, key=lambda name: max(psnrs[name]) - min(psnrs[name]), reverse=True)
    return fill(
        "side_by_side.html",
        title=" | ".join(names),
        runs=list(zip(names, colors, strict=True)),
        rows=rows,
        curves=psnr_over_time([(c.seconds, c.psnr) for c in curves], colors),
        views=shown((view_of(lineup(name)) for name in ordered[:MOST]), ROOM),
        scores=[(name, marked(psnrs[name])) for name in ordered],
    )


def shown(views: Iterable[dict[str, Any]], room: int) -> list[dict[str, Any]]:
    """Returns the first views, at least one, whose pictures take no more than so many bytes together."""
    kept: list[dict[str, Any]] = []
    for view in views:
        pictures = (view["photo"], view["photo_crop"], *view["images"], *view["crops"])
        room -= sum(map(len, pictures))
        if kept and room < 0:
            break
        kept.append(view)
    return kept


def marked(psnrs: Sequence[float]) -> list[tuple[float, bool]]:
    """Returns each PSNR, dB, and whether it is the best."""
    return [(value, value == max(psnrs)) for value in psnrs]


def view_of(lineup: Lineup) -> dict[str, Any]:
    """Returns a view as the template takes it."""
    box = most_different(lineup.images, lineup.mask)
    return {
        "name": lineup.name,
        "photo": data_uri(outlined(lineup.photo, box)),
        "photo_crop": data_uri(enlarged(lineup.photo, box)),
        "images": [data_uri(image) for image in lineup.images],
        "crops": [data_uri(enlarged(image, box)) for image in lineup.images],
        "psnr": marked(lineup.psnr),
    }


def most_different(images: Sequence[Picture], mask: Mask | None = None) -> tuple[int, int, int, int]:
    """Finds where pictures differ most: left, top, right and bottom of a square in them, pixels."""
    height, width = images[0].shape[:2]
    side = max(1, round(min(height, width) * CROP_FRACTION))
    spread = np.ptp(np.stack(images).astype(np.float64), axis=0).mean(axis=2)
    if mask is not None:
        spread = np.where(mask, spread, 0)
    before = side // 2  # pixels of the square before the one that the filter calls its centre
    inside = uniform_filter(spread, side)[
        before : before + height - side + 1, before : before + width - side + 1
    ]
    top, left = (int(i) for i in np.unravel_index(np.argmax(inside), inside.shape))
    return left, top, left + side, top + side


def joined(faces: Sequence[npt.NDArray[Scalar]]) -> npt.NDArray[Scalar]:
    """Returns the faces of a 360-degree photo, or masks of them, as one picture, in rows of `COLUMNS`.

    A single picture stays as it is. Places without a face, and what lies beside smaller ones, are zero.
    """
    if len(faces) == 1:
        return faces[0]
    height, width = (max(face.shape[axis] for face in faces) for axis in (0, 1))
    rows = -(-len(faces) // COLUMNS)
    whole = np.zeros((rows * height, COLUMNS * width, *faces[0].shape[2:]), faces[0].dtype)
    for number, face in enumerate(faces):
        row, column = divmod(number, COLUMNS)
        top, left = row * height, column * width
        whole[top : top + face.shape[0], left : left + face.shape[1]] = face
    return whole


def enlarged(picture: Picture, box: tuple[int, int, int, int]) -> Picture:
    """Returns a part of a picture, enlarged without interpolation."""
    crop = Image.fromarray(picture).crop(box)
    factor = -(-CROP_SHOWN // crop.width)
    return np.array(crop.resize((crop.width * factor, crop.height * factor), Image.Resampling.NEAREST))


def outlined(picture: Picture, box: tuple[int, int, int, int]) -> Picture:
    """Returns a copy of a picture with a frame around a part of it."""
    image = Image.fromarray(picture)
    left, top, right, bottom = box
    line = max(1, image.width // 360)
    ImageDraw.Draw(image).rectangle(
        (left - line, top - line, right + line - 1, bottom + line - 1), outline="red", width=line
    )
    return np.array(image)
