"""Reads VisualSFM's `.nvm` files (versions NVM_V3 and NVM_V3_R9T).

    CAPTURE/NAME.nvm      CAPTURE/images/...

    NVM_V3 [FixedK fx cx fy cy r]
    number of cameras, then for each: name, focal length, quaternion wxyz, centre, radial distortion, 0
    number of points, then for each: position, colour, measurements

Poses are world-to-camera with x right, y down, z forward. In a name, '"' stands for a space. The distortion
leads from the photo to the pinhole: u = d (1 + r |d|^2), with d relative to the centre and divided by the
focal length. (ccwu.me/vsfm/doc.html#nvm)
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, Frame, Lens, cloud
from splatax.io.datasets.fields import MOST_FRAMES, nearest_rigid, too_many
from splatax.io.datasets.finding import Photos

if TYPE_CHECKING:
    import pycolmap

LOOKED_FOR = "VisualSFM's .nvm"
NUMBERS = {"NVM_V3": 10, "NVM_V3_R9T": 15}  # after the name of a photo, by the version of the file
WAY_OUT = "Save the model again."
SAMPLES = 256  # distances from the centre at which the lens is fitted
LARGEST_ERROR = 0.05  # pixels of the fitted lens


def recognise(path: Path) -> bool:
    """Returns whether the folder holds a model of VisualSFM."""
    return any(file.is_file() for file in path.glob("*.nvm"))


def read(path: Path, downscale: int | None) -> Capture:
    """Reads the first model of a file.

    Raises:
        DatasetError: if the file is damaged, or its lens distortion is too strong.
    """
    file = next(file for file in sorted(path.glob("*.nvm")) if file.is_file())
    with blamed_on(file, "not a model of VisualSFM", WAY_OUT, DatasetError):
        lines = [line for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]
        version, *fixed = lines[0].split()
        if version not in NUMBERS:
            raise DatasetError(f"{file}: not a file of the version {' or '.join(NUMBERS)}. {WAY_OUT}")
        calibration = [float(number) for number in fixed[1:]] if fixed[:1] == ["FixedK"] else None
        count = int(lines[1])
        if not 0 <= count <= MOST_FRAMES:
            raise too_many(file, count)
        points = int(lines[2 + count]) if len(lines) > 2 + count else 0
        if points < 0 or len(lines) < 2 + count or (points and len(lines) < 3 + count + points):
            raise DatasetError(f"{file}: truncated: it does not hold what it announces. Copy it again.")
        photos = Photos(path)
        frames = [
            frame_of(file, line, NUMBERS[version], calibration, photos) for line in lines[2 : 2 + count]
        ]
        rows = [line.split(None, 6)[:6] for line in lines[3 + count :][:points]]
        numbers = np.array(rows, np.float64).reshape(-1, 6)
        found = cloud(file, numbers[:, :3], numbers[:, 3:] / 255)
    others = lines[3 + count + points :][:1]
    notes = ("several models; using the first",) if others and others[0].strip() not in ("", "0") else ()
    return Capture(file, path, frames, found, notes=notes)


def frame_of(file: Path, line: str, count: int, calibration: list[float] | None, photos: Photos) -> Frame:
    """Returns the frame of a line.

    Args:
        file: path of the file, for messages.
        line: a name and `count` numbers.
        count: 10 for a quaternion and a centre, 15 for a matrix and a translation.
        calibration: fx, cx, fy, cy and r of all photos; None if the lines have lenses of their own.
        photos: photos of the capture.

    Raises:
        DatasetError: if the pose is not valid.
    """
    words = line.split()
    name = " ".join(words[:-count]).replace('"', " ")
    numbers = np.array(words[-count:], np.float64)
    where = f"{file}, {shown(name)}"
    poses, good = nearest_rigid(pose_of(numbers)[None])
    if not good.all():
        raise DatasetError(f"{where}: its pose is not a rotation and a translation. {WAY_OUT}")
    lens = lens_of(where, calibration or [numbers[0], np.nan, numbers[0], np.nan, numbers[-2]])
    return Frame(name, photos.path_of(name, where), lens, poses[0, :3])


def pose_of(numbers: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3 4"]:
    """Returns the pose in the numbers of a line."""
    from scipy.spatial.transform import Rotation

    if len(numbers) == NUMBERS["NVM_V3_R9T"]:
        return np.column_stack([numbers[1:10].reshape(3, 3), numbers[10:13]])
    rotation = Rotation.from_quat(numbers[1:5], scalar_first=True).as_matrix()
    return np.column_stack([rotation, -rotation @ numbers[5:8]])


def lens_of(where: str, calibration: list[float]) -> Lens:
    """Returns a lens; a principal point that is NaN is the photo's centre."""
    fx, cx, fy, cy, r = (*calibration, 0.0)[:5]

    def lens(photo: Path) -> "pycolmap.Camera":
        width, height = images.size_of(photo)
        centre = (width / 2 if np.isnan(cx) else cx, height / 2 if np.isnan(cy) else cy)
        corner = float(np.hypot(width, height)) / 2 / min(fx, fy)
        radial = inverse_of(where, r, corner, max(fx, fy)) if r else ()
        return lenses.perspective((width, height), (fx, fy), centre, radial)

    return lens


def inverse_of(where: str, r: float, corner: float, focal: float) -> tuple[float, float, float]:
    """Returns k1, k2 and k3 of the lens for which u = d (1 + r d^2).

    Args:
        where: the photo, for messages.
        r: distortion of the file.
        corner: distance of the photo's corner from its centre, focal lengths.
        focal: focal length, pixels.

    Raises:
        DatasetError: if no such lens is within `LARGEST_ERROR` of it everywhere in the photo.
    """
    distorted = np.linspace(0, corner, SAMPLES + 1)[1:]
    straight = distorted * (1 + r * distorted**2)
    error = np.inf
    if np.isfinite(straight).all() and (np.diff(straight) > 0).all() and straight[0] > 0:
        terms = straight[:, None] ** [3, 5, 7]
        scale = np.abs(terms).max(axis=0)
        found = np.linalg.lstsq(terms / scale, distorted - straight, rcond=None)[0] / scale
        error = np.abs(straight + terms @ found - distorted).max() * focal
    if not error <= LARGEST_ERROR:
        raise lenses.refused(where, f"NVM with a radial distortion of {r:.3g}")
    return float(found[0]), float(found[1]), float(found[2])
