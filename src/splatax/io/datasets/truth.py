"""Reads the true geometry beside the photos of a capture, which scenes are evaluated with.

CAPTURE/truth/depth/NAME.npy    or NAME.png          world units, or thousandths of them in a 16-bit picture
CAPTURE/truth/normals/NAME.npy                       unit vectors in the world, towards the camera

NAME is that of the photo, with or without its suffix. Depth is that of the photo's lens: along the optical
axis, or the distance from the camera for lenses that map angles. It is 0 where it is unknown.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatax.dataset import TrueGeometry
from splatax.errors import DatasetError
from splatax.io.damage import blamed_on
from splatax.io.datasets import depths, names
from splatax.io.datasets.capture import DepthMap

FOLDER = "truth"
UNITS = {".npy": 1.0, ".png": 1e-3}  # world units for each unit of a file
WAY_OUT = "Make it again, or move it away."


@dataclass(frozen=True)
class TruthFiles:
    """Files of the true geometry of one photo.

    Attributes:
        depth: depth map.
        normals: normals; None if there are none.
        capture: folder in which the files must lie.
    """

    depth: DepthMap
    normals: Path | None
    capture: Path

    def read(self) -> TrueGeometry:
        """Reads the maps.

        Raises:
            DatasetError: if a file is damaged, or is not such a map.
        """
        depth = depths.read(self.depth, self.capture)
        if self.normals is None:
            return TrueGeometry(depth)
        normals = normals_in(names.confined(self.normals, self.capture))
        if normals.shape[:2] != depth.shape:
            raise DatasetError(f"{self.normals}: another size than {self.depth.path.name}. {WAY_OUT}")
        return TrueGeometry(depth, normals)


def truths_of(capture: Path, photos: Iterable[str]) -> dict[str, TruthFiles]:
    """Returns the files of each photo that has a true depth map, by the photo's name.

    Raises:
        DatasetError: if there are depth maps, but none has the name of a photo.
    """
    folder = capture / FOLDER
    found = {}
    for name in photos:
        if depth := first_of(folder / "depth", name, tuple(UNITS)):
            normals = first_of(folder / "normals", name, (".npy",))
            found[name] = TruthFiles(DepthMap(depth, UNITS[depth.suffix]), normals, capture)
    if not found and any(path.suffix in UNITS for path in (folder / "depth").rglob("*")):
        raise DatasetError(
            f"{folder / 'depth'}: none of its files has the name of a registered photo: NAME.npy or NAME.png "
            f"for NAME.jpg. Rename them, or move {folder} away."
        )
    return found


def first_of(folder: Path, name: str, suffixes: tuple[str, ...]) -> Path | None:
    """Returns the file of a photo in a folder, under its name with or without its own suffix."""
    stems = (folder / name, (folder / name).with_suffix(""))
    candidates = (stem.with_name(stem.name + suffix) for stem in stems for suffix in suffixes)
    return next((path for path in candidates if path.is_file()), None)


def normals_in(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Reads a map of normals, which are made unit vectors; 0 where they are unknown.

    Raises:
        DatasetError: if the file is damaged, or is not such a map.
    """
    with blamed_on(path, "not a map of normals that can be read", WAY_OUT, DatasetError):
        # Memory-mapped, because the header may claim any size.
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    if values.ndim != 3 or values.shape[2] != 3 or values.dtype.kind != "f" or not values.size:
        raise DatasetError(
            f"{path}: not a map of normals, but {values.dtype} numbers of shape {values.shape}. {WAY_OUT}"
        )
    normals = np.asarray(values, np.float32)
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    known = np.isfinite(lengths) & (lengths > 0.5)
    return np.where(known, normals / np.where(known, lengths, 1), 0)
