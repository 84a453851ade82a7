"""All that is measured of a capture, before anything is made of it."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatax.dataset import Dataset, View, mask_of
from splatax.inspection.looks import Look, looks_of
from splatax.io import images
from splatax.runs import forecast
from splatax.training.recipes import room_for

LOOKING, MASKS = 5.0, 24  # seconds for photos; masks that are decoded


@dataclass(frozen=True)
class Examination:
    """What was found.

    Attributes:
        path: of the capture.
        dataset: its views; None of photos without poses.
        photos: all on disk, by name.
        looks: of those that there was time for.
        errors: median reprojection error by view, pixels.
        coverage: share of pixels that count, by view, of a sample of those with masks.
        gaussians: how many the default recipe would use.
        memory: that training would then need, bytes.
        available: memory that is free here, bytes; None if unknown.
        seconds: that training would then take; None if that was not measured.
    """

    path: Path
    dataset: Dataset | None
    photos: dict[str, Path]
    looks: dict[str, Look]
    errors: dict[str, float] = field(default_factory=dict)
    coverage: dict[str, float] = field(default_factory=dict)
    gaussians: int = 0
    memory: int = 0
    available: int | None = None
    seconds: float | None = None

    @property
    def views(self) -> tuple[View, ...]:
        return self.dataset.views if self.dataset else ()


def examine(path: Path, dataset: Dataset | None) -> Examination:
    """Looks at a capture, or at photos without poses, for some seconds.

    Args:
        path: of the capture, or of a folder of photos.
        dataset: the capture; None where there are photos alone.
    """
    if dataset is None:
        photos = {p.relative_to(path).as_posix(): p for p in sorted(path.rglob("*")) if images.is_image(p)}
        return Examination(path, None, photos, looks_of(photos, LOOKING))
    survey = dataset.survey
    masked = [view for view in dataset.views if view.mask]
    coverage = {}
    for view in masked[:: -(-len(masked) // MASKS) or 1]:
        mask = mask_of(view)
        coverage[view.name] = 1.0 if mask is None else float(mask.mean())
    gaussians = room_for(dataset)
    return Examination(
        path,
        dataset,
        survey.files,
        looks_of(survey.files, LOOKING),
        {name: float(np.median(errors)) for name, errors in survey.errors.items()},
        coverage,
        gaussians,
        forecast.memory(gaussians, *forecast.photos(dataset)),
        available_memory(),
    )


def available_memory() -> int | None:
    """Bytes that are free; None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None
