"""Reads and writes points as PLY files."""

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


def read_points(path: Path) -> PointCloud:
    """Returns the coloured points of a PLY file.

    Raises:
        DatasetError: if there is no such file, it is damaged, or holds no coloured points.
    """
    way_out = "Give a PLY file of coloured points."
    if not path.is_file():
        raise DatasetError(f"{path}: no such file. {way_out}")
    return cloud_of_ply(path, way_out)


def write_points(path: Path, points: PointCloud) -> None:
    """Writes points to a PLY file; colours are rounded to 8 bits."""
    kinds = ["<f4"] * 3 + ["u1"] * 3
    rows = np.zeros(len(points), [(name, kind) for name, kind in zip(COLUMNS, kinds, strict=True)])
    for axis, name in enumerate(COLUMNS[:3]):
        rows[name] = points.positions[:, axis]
    for channel, name in enumerate(COLUMNS[3:]):
        rows[name] = np.clip(np.round(points.colors[:, channel] * 255), 0, 255)
    ply_table.write(path, {"vertex": rows}, ())
