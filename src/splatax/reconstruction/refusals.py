"""Refuses photos that no capture can be reconstructed from, and says why and what to do."""

from pathlib import Path
from typing import TYPE_CHECKING

from splatax.errors import DatasetError, InputError
from splatax.io.datasets.photos import counted
from splatax.reconstruction import diagnosis
from splatax.reconstruction.photos import Photo
from splatax.reconstruction.work import RESULTS
from splatax.reconstruction.writing import Ways

if TYPE_CHECKING:
    import pycolmap

FEWEST, LEAST_FRACTION = 3, 0.5  # number and fraction of photos that must get a pose
WIDE = "They are twice as wide as they are high: if they show 360 degrees, say so."


def existing_results(out: Path) -> None:
    """Raises an InputError if a folder holds a capture already."""
    if any((out / name).exists() for name in RESULTS):
        raise InputError(
            f"{out}: holds a capture. Choose another folder, or remove this one.",
            options=("out", "overwrite"),
        )


def undistorted_panoramas(source: Path, found: list[Photo], ways: Ways) -> None:
    """Raises an InputError if panoramas are to be copied as they are and undistorted at once."""
    if ways.undistort and not ways.faces and (around := sum(photo.panorama for photo in found)):
        raise InputError(
            f"{source}: {counted(around)} of 360 degrees, which no pinhole camera can show. Cut them into "
            "faces, or use photos as they are, without undistorting them.",
            options=("panorama_lens", "undistort"),
        )


def too_few(source: Path, photos: dict[str, Photo], rejected: dict[str, str]) -> None:
    """Raises a DatasetError if so few photos can be read that they show no depth."""
    if (count := len(set(photos.values()))) < FEWEST:
        why = f" ({len(rejected)} cannot be read, such as {next(iter(rejected))})" if rejected else ""
        raise DatasetError(
            f"{source}: {counted(count)} to use{why}, but depth needs at least {FEWEST}, better 30 or "
            "more, from different places."
        )


def too_few_placed(
    source: Path, parts: list["pycolmap.Reconstruction"], photos: dict[str, Photo], rejected: dict[str, str]
) -> None:
    """Raises a DatasetError if the largest part of a reconstruction has poses for too few of the photos."""
    count, wide = len(set(photos.values())), wide_of(photos)
    placed = parts[0].num_reg_frames() if parts else 0
    if placed < max(FEWEST, LEAST_FRACTION * count):
        raise DatasetError(
            f"{source}: only {placed} of {count} photos fit together; {most_frequent(rejected)}. "
            f"{WIDE if 2 * wide > count else diagnosis.advice(rejected)}",
            options=("panoramas all",) if 2 * wide > count else (),
        )


def wide_of(photos: dict[str, Photo]) -> int:
    """Returns the number of photos that may show 360 degrees, though their metadata do not say so."""
    return sum(photo.wide for photo in set(photos.values()))


def most_frequent(rejected: dict[str, str]) -> str:
    """Describes the most frequent reason, such as "of the others, 7: overlaps with no other photo"."""
    reasons = list(rejected.values())
    if not reasons:
        return "no two show the same from different places"
    top = max(sorted(set(reasons)), key=reasons.count)
    return f"of the others, {reasons.count(top)}: {top}"
