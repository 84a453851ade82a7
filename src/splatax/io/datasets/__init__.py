"""Captures on disk -> `Dataset`. A loader is a module with `recognise(path)` and `load(path, ...)`."""

from pathlib import Path

from splatax.dataset import Dataset
from splatax.errors import DatasetError
from splatax.io.datasets import colmap

DATASETS = (colmap,)  # the first that recognises a folder loads it


def load_dataset(path: str | Path, *, downscale: int | None = None) -> Dataset:
    """Loads a capture: its cameras, points, and photos on demand. Every 8th photo is held out.

    Args:
        path: the folder of the capture.
        downscale: divide the size of photos by this. None picks the least that brings the longer
            side to 1600 pixels or fewer.

    Raises:
        DatasetError: if it is no capture, or parts of it are missing or damaged.
    """
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"{path}: no such folder. Give the folder that holds the capture.")
    if not path.is_dir():
        raise DatasetError(f"{path}: a file, not a folder. Give the folder that holds the capture.")
    for loader in DATASETS:
        if loader.recognise(path):
            return loader.load(path, downscale=downscale)
    looked_for = "; ".join(loader.LOOKED_FOR for loader in DATASETS)
    raise DatasetError(f"{path}: not a capture that splatax knows. It looked for {looked_for}.")
