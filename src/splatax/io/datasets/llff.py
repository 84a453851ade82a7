"""LLFF's `poses_bounds.npy` (Mildenhall et al. 2019), and the photos in the order of their names.

    CAPTURE/poses_bounds.npy      CAPTURE/images/...

Each row: a 3 x 5 matrix [R | t | height, width, focal], camera-to-world with axes down, right,
back; then the depths of the nearest and the farthest point, which are not used.
"""

from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float

from splatax.dataset import Dataset, PointCloud, hold_out
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.datasets import masks, photos

FILE = "poses_bounds.npy"
LOOKED_FOR = f"LLFF's {FILE}"
ROW = 17
RIGID_TOLERANCE = 1e-2  # of R R^T against the identity


def recognise(path: Path) -> bool:
    """Whether the folder holds LLFF's poses."""
    return (path / FILE).is_file()


def load(path: Path, *, downscale: int | None = None) -> Dataset:
    """Loads a capture; see `load_dataset`."""
    rows = read(path / FILE)
    folder, already = photos.photo_folder(path, downscale)
    found = sorted(photo for photo in folder.iterdir() if images.is_image(photo))
    if len(found) != len(rows):
        raise DatasetError(
            f"{path / FILE}: poses of {len(rows)} photos, but {folder} holds {len(found)}; they belong "
            "together by order alone, so all must be there. Put back the folder as it was."
        )
    beside = masks.masks_of(path, [photo.name for photo in found])
    sources = [
        photos.source_of(photo.name, photo, lens_of(row), pose_of(row), beside.get(photo.name))
        for photo, row in zip(found, rows, strict=True)
    ]
    factor = photos.shrink_factor(sources, already, downscale)
    views = [source.view(factor) for source in sources]
    train, test = hold_out(views)
    notes = (
        f"{len(views)} photos with poses, {len(test)} held out for testing",
        f"no points; photos {photos.sizes_of(views)} from {folder.name}/{photos.scaling(factor)}",
    )
    none = np.zeros((0, 3), np.float32)
    return Dataset(train, test, PointCloud(none, none), notes, survey=photos.survey(sources, (), {}))


def read(path: Path) -> Float[np.ndarray, "n 17"]:
    """The rows of the file.

    Raises:
        DatasetError: if it is no array of the format, or a pose is no rotation.
    """
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: not an array that NumPy can read ({error}). Copy it again.") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != ROW or rows.dtype.kind != "f":
        shape = getattr(rows, "shape", "several arrays")
        raise DatasetError(f"{path}: LLFF's poses are rows of {ROW} numbers, not {shape}. Make it again.")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    with np.errstate(all="ignore"):
        rotations = matrices[:, :, :3]
        off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
        wrong = (
            ~np.isfinite(matrices).all((1, 2)) | ~(off < RIGID_TOLERANCE) | (matrices[:, :, 4] <= 0).any(1)
        )
    if not len(rows) or wrong.any():
        which = f"row {int(np.argmax(wrong))} is no pose" if len(rows) else "it has no rows"
        raise DatasetError(f"{path}: {which}. Make the file again.")
    return rows.astype(np.float64)


def lens_of(row: Float[np.ndarray, "17"]) -> pycolmap.Camera:
    height, width, focal = row[:15].reshape(3, 5)[:, 4]
    return pycolmap.Camera(
        model="PINHOLE",
        width=round(width),
        height=round(height),
        params=[focal, focal, width / 2, height / 2],
    )


def pose_of(row: Float[np.ndarray, "17"]) -> Float[np.ndarray, "3 4"]:
    """From world to camera axes x right, y down, z forward."""
    down, right, back, position = row[:15].reshape(3, 5)[:, :4].T
    rotation = np.stack([right, down, -back])
    return np.column_stack([rotation, -rotation @ position])
