"""Reads LLFF's `poses_bounds.npy` (Mildenhall et al. 2019), with the photos in the order of their names.

    CAPTURE/poses_bounds.npy      CAPTURE/images/...

Each row has a 3 x 5 matrix [R | t | height, width, focal], camera-to-world with axes down, right, back,
then the depths of the nearest and the farthest point, which are not used.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import names, photos
from splatax.io.datasets.capture import Capture, Frame, always

if TYPE_CHECKING:
    import pycolmap

FILE = "poses_bounds.npy"
LOOKED_FOR = f"LLFF's {FILE}"
ROW = 17
RIGID_TOLERANCE = 1e-2  # of R R^T against the identity


def recognise(path: Path) -> bool:
    """Returns whether the folder holds LLFF's poses."""
    return (path / FILE).is_file()


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture, whose photos are matched with the poses only by their order."""
    rows = rows_of(path / FILE)
    folder, already = photos.photo_folder(path, downscale)
    found = sorted(photo for photo in folder.iterdir() if images.is_image(photo))
    if len(found) != len(rows):
        raise DatasetError(
            f"{path / FILE}: poses of {len(rows)} photos, but {folder} holds {len(found)}; they belong "
            "together by order alone, so all must be there. Put back the folder as it was."
        )
    frames = [
        Frame(names.checked(photo.name, folder), photo, always(lens_of(row)), pose_of(row))
        for photo, row in zip(found, rows, strict=True)
    ]
    return Capture(path / FILE, path, frames, photos=folder, already=already)


def rows_of(path: Path) -> Float[np.ndarray, "n 17"]:
    """Returns the rows of the file.

    Raises:
        DatasetError: if the array has another shape or type, or a pose or a photo's size is not valid.
    """
    with blamed_on(path, "not an array that NumPy can read", "Copy it again.", DatasetError):
        # Memory-mapped, because the header may claim any size.
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != ROW or rows.dtype.kind != "f":
        shape = getattr(rows, "shape", "several arrays")
        raise DatasetError(f"{path}: LLFF's poses are rows of {ROW} numbers, not {shape}. Make it again.")
    rows = np.array(rows, np.float64)
    matrices = rows[:, :15].reshape(-1, 3, 5)
    with np.errstate(all="ignore"):
        rotations = matrices[:, :, :3]
        off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
        wrong = (
            ~np.isfinite(matrices).all((1, 2))
            | ~(off < RIGID_TOLERANCE)
            | (matrices[:, :2, 4] < 1).any(1)
            | (matrices[:, :2, 4] > photos.LARGEST_CAMERA).any(1)
            | (matrices[:, 2, 4] <= 0)
        )
    if not len(rows) or wrong.any():
        which = f"row {int(np.argmax(wrong))} is no pose" if len(rows) else "it has no rows"
        raise DatasetError(f"{path}: {which}. Make the file again.")
    return rows


def lens_of(row: Float[np.ndarray, "17"]) -> "pycolmap.Camera":
    """Returns the camera of a row, a pinhole whose principal point is at the photo's centre."""
    import pycolmap

    height, width, focal = row[:15].reshape(3, 5)[:, 4]
    return pycolmap.Camera(
        model="PINHOLE",
        width=round(width),
        height=round(height),
        params=[focal, focal, width / 2, height / 2],
    )


def pose_of(row: Float[np.ndarray, "17"]) -> Float[np.ndarray, "3 4"]:
    """Returns the world-to-camera transform of a row, with x right, y down, z forward."""
    down, right, back, position = row[:15].reshape(3, 5)[:, :4].T
    rotation = np.stack([right, down, -back])
    return np.column_stack([rotation, -rotation @ position])
