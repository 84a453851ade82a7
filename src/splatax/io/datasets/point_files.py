"""Reads and writes points as PLY files with the columns x, y, z, red, green, blue."""

from pathlib import Path

import numpy as np

from splatax.dataset import PointCloud
from splatax.errors import DatasetError
from splatax.io.damage import blamed_on
from splatax.io.formats import ply_table

COLUMNS = ("x", "y", "z", "red", "green", "blue")


def read_points(path: Path, way_out: str = "Give a PLY file of coloured points.") -> PointCloud:
    """Returns the points of a PLY file.

    Args:
        path: of the file. Colours are of 8 bits, or in [0, 1].
        way_out: a sentence for messages.

    Raises:
        DatasetError: if there is no such file, it is damaged, or holds no coloured points.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: no such file. {way_out}")
    with blamed_on(path, "no coloured points can be read from it", way_out, DatasetError):
        vertex = ply_table.read(path).elements["vertex"]
        columns = [vertex[column].astype(np.float64) for column in COLUMNS]
    positions, colors = np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1)
    if not np.isfinite(positions).all():
        raise DatasetError(f"{path}: some points are at no finite place. Export the points again.")
    scale = 255 if vertex["red"].dtype.kind == "u" else 1
    return PointCloud(positions.astype(np.float32), (colors / scale).astype(np.float32))


def write_points(path: Path, points: PointCloud) -> None:
    """Writes points to a PLY file; colours are rounded to 8 bits."""
    kinds = ["<f4"] * 3 + ["u1"] * 3
    rows = np.zeros(len(points), [(name, kind) for name, kind in zip(COLUMNS, kinds, strict=True)])
    for axis, name in enumerate(COLUMNS[:3]):
        rows[name] = points.positions[:, axis]
    for channel, name in enumerate(COLUMNS[3:]):
        rows[name] = np.clip(np.round(points.colors[:, channel] * 255), 0, 255)
    ply_table.write(path, {"vertex": rows}, ())
