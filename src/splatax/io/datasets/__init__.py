"""Reads captures: photos with cameras and poses, points and depth, as many programs write them.

A reader is a module with `LOOKED_FOR`, `recognise(folder)` and `read(folder, downscale)`; it is one line of
`DATASETS`. It returns a `Capture`, which `assembly` makes into a `Dataset`. A reader may raise any exception
on a damaged capture; `load_dataset` turns it into a `DatasetError`.
"""

from pathlib import Path
from types import ModuleType

from splatax.dataset import Dataset
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
from splatax.io.datasets.photos import counted

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


def load_dataset(path: str | Path, *, downscale: int | None = None) -> Dataset:
    """Loads a capture: its cameras and points, and its photos on demand.

    Every 8th photo is held out, unless the capture itself lists the photos to hold out.

    Args:
        path: folder of the capture, or a zip file of it.
        downscale: factor by which photos are shrunk. None selects the smallest whole number that brings
            the longer side to at most 1600 pixels.

        Raises:
            DatasetError: if the path is not a capture, or a part of it is missing, damaged or elsewhere.
    """
    folder = folder_of(Path(path))
    with blamed_on(Path(path), "not a capture that can be read", "Make or copy it again.", DatasetError):
        if (reader := reader_of(folder)) is not None:
            return dataset_of(reader.read(folder, downscale), downscale)
    looked_for = "; ".join(reader.LOOKED_FOR for reader in DATASETS.values())
    raise DatasetError(
        f"{path}: not a capture that splatax knows. It looked for {looked_for}. It found {contents(folder)}."
    )


def reader_of(folder: Path) -> ModuleType | None:
    """Returns the reader of the capture in a folder; None if the folder holds none that is known."""
    return next((reader for reader in DATASETS.values() if reader.recognise(folder)), None)


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
