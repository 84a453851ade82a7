"""Measurements of a capture before training."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatax.cameras.lenses import Equirectangular
from splatax.dataset import Dataset, View, by_photo, mask_of
from splatax.errors import DatasetError, InputError, shown
from splatax.inspection.detail import sampled_points
from splatax.inspection.looks import Look, joined, looks_of
from splatax.reconstruction.photos import HEIF_PACKAGE, Photo, files_of, is_heif, learn_heif, photo_of
from splatax.runs import forecast
from splatax.runs.planning import room_within
from splatax.training.recipes import room_for

LOOKING, MASKS = 5.0, 24  # seconds spent on photos; number of masks that are decoded


@dataclass(frozen=True)
class Examination:
    """Measurements of a capture, or of photos without poses.

    Attributes:
        path: path of the capture.
        dataset: the capture; None for photos without poses.
        photos: paths of all photos on disk, by name.
        looks: appearance of the photos that there was time for, by name.
        errors: median reprojection error of each view, pixels, by name.
        panoramas: names of the 360-degree photos.
        wide: names of photos that may be some, though their metadata do not say so; of photos without poses.
        coverage: fraction of unmasked pixels, by name, for a sample of the views with masks.
        unused: reasons why other files in the folder cannot be used, by name; of photos without poses.
        bad_masks: reasons why masks cannot be used, by name; of the same sample.
        gaussians: number of Gaussians that a run with default options would grow to.
        memory: memory that it would need, bytes.
        available: free memory of this machine, bytes; None if unknown.
        steps: number of steps of that run; None if the speed of this machine was not measured.
        seconds: time that they would take; None if the speed was not measured.
    """

    path: Path
    dataset: Dataset | None
    photos: dict[str, Path]
    looks: dict[str, Look]
    errors: dict[str, float] = field(default_factory=dict)
    panoramas: tuple[str, ...] = ()
    wide: tuple[str, ...] = ()
    coverage: dict[str, float] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    bad_masks: dict[str, str] = field(default_factory=dict)
    gaussians: int = 0
    memory: int = 0
    available: int | None = None
    steps: int | None = None
    seconds: float | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """One view of each photo with a pose."""
        return self.dataset.standpoints if self.dataset else ()


def examine(path: Path, dataset: Dataset | None) -> Examination:
    """Measures a capture, or photos without poses, which takes a few seconds.

    Args:
        path: path of the capture, or of a folder of photos.
        dataset: the capture; None for photos without poses.
    """
    if dataset is None:
        photos, unused = photos_and_others(path)
        headers = [photo for name, file in photos.items() if (photo := header_of(name, file))]
        return Examination(
            path,
            None,
            photos,
            looks_of(photos, LOOKING),
            panoramas=tuple(photo.name for photo in headers if photo.panorama),
            wide=tuple(photo.name for photo in headers if photo.wide),
            unused=unused,
        )
    masked = [view for view in dataset.views if view.mask]
    coverage, bad_masks = {}, {}
    for view in masked[:: -(-len(masked) // MASKS) or 1]:
        try:
            mask = mask_of(view)
            coverage[view.name] = 1.0 if mask is None else float(mask.mean())
        except DatasetError as error:
            bad_masks[view.name] = str(error)
    gaussians = room_for(dataset)
    return replace(
        surveyed(path, dataset),
        looks=looks_at(dataset),
        coverage=coverage,
        bad_masks=bad_masks,
        gaussians=gaussians,
        memory=memory_for(dataset, gaussians),
        available=available_memory(),
    )


def looks_at(dataset: Dataset) -> dict[str, Look]:
    """Returns measurements of the photos of a capture, by name, for as many as there is time for."""
    views = {view.name: view for view in dataset.views}
    seen = looks_of(dataset.survey.files, LOOKING, views, sampled_points(dataset))
    return {
        name: looks[0] if len(looks) == 1 else joined(looks)
        for name, looks in by_photo(dataset.views, seen).items()
    }


def memory_for(dataset: Dataset, gaussians: int) -> int:
    """Returns the memory that training to this number of Gaussians would need, bytes."""
    width, height, photos_bytes = forecast.photos(dataset)
    in_memory = min(photos_bytes, room_within(None, dataset, 0).photos)
    return forecast.memory(gaussians, width, height, round(in_memory))


def surveyed(path: Path, dataset: Dataset) -> Examination:
    """Returns the measurements of a capture that need no look at its photos.

    Args:
        path: path of the capture.
        dataset: the capture.
    """
    files = dataset.survey.files
    return Examination(
        path,
        dataset,
        {view.photo: files[view.name] for view in dataset.standpoints if view.name in files},
        looks={},
        errors={
            name: float(np.median(np.concatenate(errors)))
            for name, errors in by_photo(dataset.views, dataset.survey.errors).items()
        },
        panoramas=tuple(dict.fromkeys(view.photo for view in dataset.views if whole_sphere(view))),
    )


def photos_and_others(folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """Returns the photos in a folder and the reasons why other files cannot be used, both by name."""
    photos, unused = files_of(folder)
    if heif := [path for path in photos if is_heif(path)]:
        try:
            learn_heif(heif[0])
        except InputError:
            unused |= dict.fromkeys(heif, HEIF_PACKAGE)
            photos = [path for path in photos if path not in unused]
    return (
        {path.relative_to(folder).as_posix(): path for path in photos},
        {shown(path.relative_to(folder).as_posix()): why for path, why in unused.items()},
    )


def whole_sphere(view: View) -> bool:
    """Returns whether a view is a 360-degree photo or a face of one."""
    return view.face_of is not None or isinstance(view.camera.lens, Equirectangular)


def header_of(name: str, file: Path) -> Photo | None:
    """Returns the header of a photo; None if it cannot be read, which is reported with its measurements."""
    try:
        return photo_of(name, file)
    except DatasetError:
        return None


def available_memory() -> int | None:
    """Returns the free memory in bytes; None if the system does not report it."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None
