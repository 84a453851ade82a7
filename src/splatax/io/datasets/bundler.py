"""Reads Bundler's `bundle.out` (version 0.3) with its list of photos.

    CAPTURE/bundle.out  or  CAPTURE/bundle/bundle.out  or  CAPTURE/NAME.bundle.out
    CAPTURE/list.txt    or  the same beside the bundle, or CAPTURE/NAME.list.txt

Poses are world-to-camera with OpenGL's axes; the distortion is 1 + k1 r^2 + k2 r^4 about the photo's centre.
A focal length of zero marks a photo that is not registered.
(www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html)
"""

import re
from pathlib import Path

import numpy as np

from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import FROM_OPENGL, Capture, Frame, Lens, cloud
from splatax.io.datasets.fields import MOST_FRAMES, nearest_rigid, too_many
from splatax.io.datasets.finding import Photos

LOOKED_FOR = "Bundler's bundle.out"
FILES = ("bundle.out", "bundle/bundle.out", "*.bundle.out")
LIST = "list.txt"
LINES_OF_CAMERA, LINES_OF_POINT = 5, 3
NAME = re.compile(r"(.+?)(?:\s+0\s+[-+.\deE]+)?")  # the focal length of the EXIF data may follow
WAY_OUT = "Export the bundle again."


def recognise(path: Path) -> bool:
    """Returns whether the folder holds a bundle."""
    return bool(bundles_in(path))


def bundles_in(path: Path) -> list[Path]:
    """Returns the bundles of a folder."""
    return [file for pattern in FILES for file in sorted(path.glob(pattern)) if file.is_file()]


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture. Photos that are not registered are left out, and counted.

    Raises:
        DatasetError: if a file is damaged, or there is no list of the photos.
    """
    file = bundles_in(path)[0]
    photos = Photos(path)
    with blamed_on(file, "not a bundle of version 0.3", WAY_OUT, DatasetError):
        lines = [line for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]
        count, points = (int(number) for number in lines[0].split())
        if not 0 <= count <= MOST_FRAMES:
            raise too_many(file, count)
        start = 1 + LINES_OF_CAMERA * count
        if points < 0 or len(lines) < start + LINES_OF_POINT * points:
            raise DatasetError(f"{file}: truncated: it does not hold what it announces. Copy it again.")
        listed = names_in(list_of(path, file), count)
        frames = []
        for i, name in enumerate(listed):
            rows = lines[1 + LINES_OF_CAMERA * i :][:LINES_OF_CAMERA]
            where = f"{file}, {shown(name)}"
            focal, k1, k2 = (float(number) for number in rows[0].split())
            if focal:
                pose = pose_of(where, rows[1:])
                frames.append(Frame(name, photos.path_of(name, where), lens_of(focal, k1, k2), pose))
        positions, colors = (
            np.array([line.split() for line in lines[start + row :: LINES_OF_POINT][:points]], np.float64)
            for row in range(2)
        )
        found = cloud(file, positions.reshape(-1, 3), colors.reshape(-1, 3) / 255)
    left_out = len(listed) - len(frames)
    notes = (f"{left_out} photos of the list are not registered",) if left_out else ()
    return Capture(file, path, frames, found, notes=notes)


def list_of(path: Path, file: Path) -> Path:
    """Returns the list of the photos of a bundle.

    Raises:
        DatasetError: if there is none.
    """
    prefix = file.name.removesuffix("bundle.out")
    candidates = [path / f"{prefix}{LIST}", path / LIST, file.parent / LIST]
    if found := next((candidate for candidate in candidates if candidate.is_file()), None):
        return found
    raise DatasetError(f"{path / LIST}: no list of the photos. Put it there, one name on each line.")


def names_in(file: Path, count: int) -> list[str]:
    """Returns the names in a list of photos.

    Raises:
        DatasetError: if their number is not that of the cameras.
    """
    with blamed_on(file, "not a list of photos", WAY_OUT, DatasetError):
        lines = [line.strip() for line in file.read_text().splitlines() if line.strip()]
        found = [match[1] for line in lines if (match := NAME.fullmatch(line))]
    if len(found) != count:
        raise DatasetError(f"{file}: {len(found)} photos, but the bundle has {count} cameras. {WAY_OUT}")
    return found


def pose_of(where: str, rows: list[str]) -> np.ndarray:
    """Returns a pose from the three rows of its rotation and its translation.

    Raises:
        DatasetError: if it is not a rotation and a translation.
    """
    numbers = np.array([row.split() for row in rows], np.float64)
    poses, good = nearest_rigid(np.column_stack([numbers[:3], numbers[3]])[None])
    if not good.all():
        raise DatasetError(f"{where}: its pose is not a rotation and a translation. {WAY_OUT}")
    return (FROM_OPENGL @ poses[0])[:3]


def lens_of(focal: float, k1: float, k2: float) -> Lens:
    """Returns the lens of a photo, whose principal point is at its centre."""

    def lens(photo: Path):
        width, height = images.size_of(photo)
        return lenses.perspective((width, height), (focal, focal), (width / 2, height / 2), (k1, k2))

    return lens
