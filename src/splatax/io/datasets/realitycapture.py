"""Reads the "Internal/External camera parameters" that RealityCapture and RealityScan export as CSV.

    CAPTURE/NAME.csv      CAPTURE/images/...      CAPTURE/points.ply (optional, the only .ply file)

    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2

Angles are in degrees. At zero the camera looks down, with north at the top of the photo: the rotation from
the camera, with OpenGL's axes, is Rz(-heading) Rx(pitch) Ry(roll), and z is up. f is for a photo 36 mm wide
along its longer side; px and py are fractions of that side, from the photo's centre. The distortion is
Brown's (k1, k2, k3, t1, t2). (rshelp.capturingreality.com: export of registrations; camera models)
"""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, Frame, Lens, from_opengl
from splatax.io.datasets.fields import MOST_FRAMES, too_many
from splatax.io.datasets.finding import Photos
from splatax.io.datasets.points import points_beside

LOOKED_FOR = "RealityCapture's camera parameters (.csv)"
POSITION, ANGLES = ("x", "y", "alt"), ("heading", "pitch", "roll")
REQUIRED = {"name", *POSITION, *ANGLES, "f"}
FILM = 36.0  # millimetres of the longer side
LONGEST_LINE = 4096  # bytes


def recognise(path: Path) -> bool:
    """Returns whether the folder holds camera parameters of RealityCapture."""
    return any(has_header(file) for file in path.glob("*.csv"))


def has_header(file: Path) -> bool:
    """Returns whether one of the first two lines of a file names the required columns."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return any(
            set(columns_of(opened.readline(LONGEST_LINE).decode(errors="replace"))) >= REQUIRED
            for _ in range(2)
        )


def columns_of(line: str) -> list[str]:
    """Returns the columns that a line names."""
    return [name.strip().lstrip("\ufeff#").lower() for name in line.split(",")]


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture.

    Raises:
        DatasetError: if the file is damaged, or its lens model cannot be undistorted.
    """
    file = next(file for file in sorted(path.glob("*.csv")) if has_header(file))
    with blamed_on(file, "not a table of camera parameters", "Export it again.", DatasetError):
        lines = file.read_text(encoding="utf-8-sig").splitlines()
        while not set(columns := columns_of(lines[0])) >= REQUIRED:
            del lines[0]
        if len(lines) > MOST_FRAMES:
            raise too_many(file, len(lines))
        photos, frames = Photos(path), []
        for row in csv.reader(lines[1:]):
            if not row:
                continue
            entries = dict(zip(columns, row, strict=True))
            name = entries.pop("name")
            where = f"{file}, {shown(name)}"
            values = {column: float(text) for column, text in entries.items() if text.strip()}
            if values.get("k4"):
                raise lenses.refused(where, "Brown4 (k4 is not zero)")
            frames.append(Frame(name, photos.path_of(name, where), lens_of(values), pose_of(values)))
    return Capture(file, path, frames, points_beside(path))


def lens_of(values: dict[str, float]) -> Lens:
    """Returns the lens of a row, which is independent of the photo's size in pixels."""
    radial = values.get("k1", 0.0), values.get("k2", 0.0), values.get("k3", 0.0)
    tangential = values.get("t1", 0.0), values.get("t2", 0.0)

    def lens(photo: Path):
        width, height = images.size_of(photo)
        longer = max(width, height)
        focal = values["f"] / FILM * longer
        centre = (width / 2 + values.get("px", 0.0) * longer, height / 2 + values.get("py", 0.0) * longer)
        return lenses.perspective((width, height), (focal, focal), centre, radial, tangential)

    return lens


def pose_of(values: dict[str, float]) -> Float[np.ndarray, "3 4"]:
    """Returns the pose of a row."""
    from scipy.spatial.transform import Rotation

    heading, pitch, roll = (values[angle] for angle in ANGLES)
    world_from_cam = np.eye(4)
    # Capital letters: each rotation is about an axis that the ones before it have turned.
    world_from_cam[:3, :3] = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    world_from_cam[:3, 3] = [values[axis] for axis in POSITION]
    return from_opengl(world_from_cam[None])[0]
