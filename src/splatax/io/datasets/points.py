"""Reads the points of a capture from a PLY file."""

from pathlib import Path

import numpy as np

from splatax.dataset import PointCloud
from splatax.errors import DatasetError
from splatax.io.damage import blamed_on
from splatax.io.datasets import names
from splatax.io.datasets.capture import NO_POINTS, cloud
from splatax.io.formats import ply_table

COLUMNS = ("x", "y", "z", "red", "green", "blue")


def cloud_of_ply(ply: Path, way_out: str) -> PointCloud:
    """Returns the coloured points of a PLY file.

    Raises:
        DatasetError: if the file is damaged, or holds no coloured points.
    """
    with blamed_on(ply, "no coloured points can be read from it", way_out, DatasetError):
        vertex = ply_table.read(ply).elements["vertex"]
        columns = [vertex[name].astype(np.float64) for name in COLUMNS]
    scale = 255 if vertex["red"].dtype.kind == "u" else 1
    return cloud(ply, np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1) / scale)


def points_beside(folder: Path) -> PointCloud:
    """Returns the points of the only PLY file in a folder; no points if there are none or several files."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".ply")
    if len(found) != 1:
        return NO_POINTS
    way_out = "Export the points with colors and in the coordinates of the cameras, or move the file away."
    return cloud_of_ply(names.confined(found[0], folder), way_out)
