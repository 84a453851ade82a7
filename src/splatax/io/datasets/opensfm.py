"""Reads the `reconstruction.json` of OpenSfM and OpenDroneMap.

    CAPTURE/reconstruction.json  or  CAPTURE/opensfm/reconstruction.json       CAPTURE/images/...

A shot has an axis-angle rotation and a translation from the world to the camera, with x right, y down,
z forward. Focal lengths and principal points are fractions of the photo's longer side, the latter from its
centre. (opensfm.readthedocs.io: dataset.html, geometry.html)
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from splatax.dataset import PointCloud
from splatax.errors import DatasetError, shown
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, Frame, always, cloud
from splatax.io.datasets.fields import MOST_FRAMES, Fields, read_json, too_many
from splatax.io.datasets.finding import Photos

if TYPE_CHECKING:
    import pycolmap

FILES = ("reconstruction.json", "opensfm/reconstruction.json")
LOOKED_FOR = "reconstruction.json of OpenSfM or OpenDroneMap"
WAY_OUT = "Run OpenSfM again."
PERSPECTIVE = ("perspective", "simple_radial", "radial", "brown")
FISHEYE = ("fisheye", "fisheye_opencv")


def recognise(path: Path) -> bool:
    """Returns whether the folder holds a reconstruction of OpenSfM."""
    return any((path / name).is_file() for name in FILES)


def read(path: Path, downscale: int | None) -> Capture:
    """Reads the largest reconstruction of a capture.

    Raises:
        DatasetError: if the file is damaged, or a lens model cannot be undistorted.
    """
    file = next(path / name for name in FILES if (path / name).is_file())
    models = read_json(file)
    if not isinstance(models, list) or not models or not all(isinstance(model, dict) for model in models):
        raise DatasetError(f"{file}: not a list of reconstructions. {WAY_OUT}")
    with blamed_on(file, "the reconstruction is damaged", WAY_OUT, DatasetError):
        model = max(models, key=lambda model: len(model["shots"]))
        if len(model["shots"]) > MOST_FRAMES:
            raise too_many(file, len(model["shots"]))
        cameras = {}
        photos, frames = Photos(path), []
        for name, shot in model["shots"].items():
            where = f"{file}, {shown(name)}"
            camera = shot["camera"]
            if camera not in cameras:
                fields = Fields(f"{file}, camera {shown(camera)}", model["cameras"][camera])
                cameras[camera] = always(lens_of(fields))
            frames.append(Frame(name, photos.path_of(name, where), cameras[camera], pose_of(shot)))
        points = points_of(file, model)
    notes = (f"{len(models)} reconstructions; using the largest",) if len(models) > 1 else ()
    return Capture(file, path, frames, points, notes=notes)


def pose_of(shot: dict[str, Any]) -> Float[np.ndarray, "3 4"]:
    """Returns the pose of a shot."""
    from scipy.spatial.transform import Rotation

    turn, translation = (np.array(shot[key], np.float64).reshape(3) for key in ("rotation", "translation"))
    return np.column_stack([Rotation.from_rotvec(turn).as_matrix(), translation])


def lens_of(fields: Fields) -> "pycolmap.Camera":
    """Returns a camera.

    Raises:
        DatasetError: if an entry is missing, or the lens model cannot be undistorted.
    """
    model = fields.text("projection_type") or "perspective"
    if model not in PERSPECTIVE + FISHEYE:
        raise lenses.refused(fields.where, model)
    width, height = fields.side("width"), fields.side("height")
    focal_x = fields.positive("focal_x") or fields.positive("focal")
    focal_y = fields.positive("focal_y") or focal_x
    if width is None or height is None or focal_x is None or focal_y is None:
        raise DatasetError(f"{fields.where}: it has no width, height or focal length. {WAY_OUT}")
    longer = max(width, height)

    def value(name: str) -> float:
        return fields.number(name) or 0.0

    focal = focal_x * longer, focal_y * longer
    centre = width / 2 + value("c_x") * longer, height / 2 + value("c_y") * longer
    k1, k2, k3, k4 = (value(f"k{i}") for i in (1, 2, 3, 4))
    tangential = value("p1"), value("p2")
    if model in FISHEYE:
        return lenses.fisheye((width, height), focal, centre, (k1, k2, k3, k4), tangential)
    return lenses.perspective((width, height), focal, centre, (k1, k2, k3), tangential)


def points_of(file: Path, model: dict[str, Any]) -> PointCloud:
    """Returns the points of a reconstruction."""
    points = list((model.get("points") or {}).values())
    positions = np.array([point["coordinates"] for point in points], np.float64).reshape(-1, 3)
    colors = np.array([point["color"] for point in points], np.float64).reshape(-1, 3)
    return cloud(file, positions, colors / 255)
