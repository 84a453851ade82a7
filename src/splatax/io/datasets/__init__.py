"""Reads captures: photos with cameras and poses, points and depth, as many programs write them.

A reader is a module with `LOOKED_FOR`, `recognise(folder)` and `read(folder, downscale)`; it is one line of
`DATASETS`. It returns a `Capture`, which `assembly` makes into a `Dataset`. A reader may raise any exception
on a damaged capture; `load_dataset` turns it into a `DatasetError`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from splatax.dataset import Dataset, photos_in, resplit
from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import (
    archives,
    bundler,
    colmap,
    llff,
    metashape,
    nvm,
    openmvg,
    opensfm,
    polycam,
    realitycapture,
    record3d,
    transforms,
)
from splatax.io.datasets.assembly import dataset_of
from splatax.io.datasets.colmap_writing import PLACE
from splatax.io.datasets.photos import counted, listed
from splatax.io.video import is_video
from splatax.splits import Every, HoldOut, Listed, listed_in, matched

DATASETS: dict[str, ModuleType] = {  # the first that recognises a folder reads it
    "COLMAP": colmap,
    "nerfstudio, instant-ngp, Blender": transforms,
    "LLFF": llff,
    "Polycam": polycam,
    "Record3D": record3d,
    "OpenSfM, OpenDroneMap": opensfm,
    "OpenMVG": openmvg,
    "Metashape": metashape,
    "RealityCapture": realitycapture,
    "Bundler": bundler,
    "VisualSFM": nvm,
}
TEST_LIST = "test.txt"  # of the capture or of its COLMAP model: names of the photos to hold out, one a line


def load_dataset(
    path: str | Path,
    *,
    downscale: int | None = None,
    hold_out: HoldOut | None = None,
    undistort: bool = False,
) -> Dataset:
    """Loads a capture: its cameras and points, and its photos on demand.

    Args:
        path: folder of the capture, or a zip file of it.
        downscale: factor by which photos are shrunk. None selects the smallest whole number that brings
            the longer side to at most 1600 pixels.
        hold_out: rule for the photos to hold out. None holds out those that the capture itself lists, in
            test.txt or in the files of its layout, else every 8th, from the 5th.
        undistort: resamples photos for pinhole cameras. Without it, views have the lenses of their photos,
            which are used as they are.

    Raises:
        DatasetError: if the path is not a capture, or a part of it is missing, damaged or elsewhere.
        InputError: if the rule names a photo that is not there, or leaves none to train on.
    """
    folder = folder_of(Path(path))
    with blamed_on(Path(path), "not a capture that can be read", "Make or copy it again.", DatasetError):
        if (reader := reader_of(folder)) is None:
            looked_for = "; ".join(reader.LOOKED_FOR for reader in DATASETS.values())
            raise DatasetError(
                f"{path}: not a capture that splatax knows. It looked for {looked_for}. It found "
                f"{contents(folder)}."
            )
        dataset = dataset_of(reader.read(folder, downscale), downscale, undistort)
    return split(dataset, folder, hold_out)


def reader_of(folder: Path) -> ModuleType | None:
    """Returns the reader of the capture in a folder; None if the folder holds none that is known."""
    return next((reader for reader in DATASETS.values() if reader.recognise(folder)), None)


def split(dataset: Dataset, folder: Path, rule: HoldOut | None) -> Dataset:
    """Returns a capture with its held-out views, and a note about them.

    Args:
        dataset: as its loader returned it; `split` is set if its files define the held-out views.
        folder: of the capture.
        rule: see `load_dataset`.

    Raises:
        DatasetError: if the capture's list of test photos names none of its photos.
        InputError: if the rule names a photo that is not there, or leaves none to train on.
    """
    unknown: tuple[str, ...] = ()
    if rule is None and not dataset.split:
        names = [name for view in dataset.views for name in (view.name, view.photo)]
        listed_ones, unknown = own_list(folder, list(dict.fromkeys(names)))
        rule = listed_ones or Every()
    if rule is not None:
        dataset = resplit(dataset, rule)
    held_out, every = photos_in(dataset.test), photos_in(dataset.views)
    note = f"{held_out} of {counted(every)} held out for testing: {dataset.split}"
    if not held_out and rule == Every():
        are = "is" if every == 1 else "are"
        note = f"no photo is held out: {counted(every)} {are} too few, so all are trained on"
    elif not held_out:
        note = "no photo is held out, so all are trained on"
    notes = [*dataset.notes, note]
    if unknown:
        them = "that has no pose or is" if len(unknown) == 1 else "that have no pose or are"
        notes.append(f"{TEST_LIST} names {counted(len(unknown))} {them} not there: {listed(unknown)}")
    return replace(dataset, notes=tuple(notes))


def own_list(folder: Path, names: Sequence[str]) -> tuple[Listed | None, tuple[str, ...]]:
    """Returns the photos that a capture's test.txt holds out, and the names in it that none with a pose has.

    Without such a file, the first is None.

    Raises:
        DatasetError: if it names none of the photos.
    """
    for path in (folder / TEST_LIST, folder / PLACE / TEST_LIST):
        if path.is_file():
            wanted = listed_in(str(path))
            if not (found := matched(wanted, names)):
                raise DatasetError(
                    f"{path}: names none of the photos with a pose, which are {shown(names[0])} to "
                    f"{shown(names[-1])}. Correct the list, or remove it."
                )
            unknown = tuple(name for name in wanted if name not in found)
            return Listed(tuple(dict.fromkeys(found.values())), path.name), unknown
    return None, ()


def is_capture(path: Path) -> bool:
    """Returns whether a path is a folder that holds a capture, or a zip file, which may hold one."""
    if path.is_file():
        return path.suffix.lower() == ".zip"
    return path.is_dir() and reader_of(path) is not None


def folder_of(path: Path) -> Path:
    """Returns the folder of a capture, unpacked first if it is a zip file.

    Raises:
        DatasetError: if the path is neither a folder nor a zip file.
    """
    if not path.exists():
        raise DatasetError(f"{path}: no such folder. Give the folder that holds the capture.")
    if path.is_dir():
        return path
    if path.suffix.lower() == ".zip":
        return archives.unpacked(path)
    if is_video(path):
        raise DatasetError(
            f"{path}: a video, not a capture. Make a capture of it with splatax reconstruct, or a page with "
            "splatax create."
        )
    raise DatasetError(f"{path}: a file, not a folder or a zip file. Give the folder that holds the capture.")


def contents(folder: Path) -> str:
    """Describes the contents of a folder that is not a capture, and suggests how to use its photos."""
    if found := sum(images.is_image(photo) for photo in folder.rglob("*")):
        return f"{counted(found)} without poses: find them with splatax reconstruct"
    names = sorted(path.name for path in folder.iterdir())
    return (
        f"{', '.join(map(shown, names[:5]))}{' and more' if len(names) > 5 else ''}"
        if names
        else "an empty folder"
    )
