"""Reads OpenMVG's `sfm_data.json`.

    CAPTURE/sfm_data.json      CAPTURE/images/...

An extrinsic is a rotation from the world to the camera and the camera's centre, with x right, y down,
z forward. The type of an intrinsic is written once, and later intrinsics of the type refer to its number.
Points have no colours. (openmvg.readthedocs.io: software/SfM/SfM_OutputFormat, openMVG/cameras)
"""

from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from splatax.dataset import PointCloud
from splatax.errors import DatasetError, shown
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, Frame, Lens, always, cloud
from splatax.io.datasets.fields import MOST_FRAMES, nearest_rigid, read_json, too_many
from splatax.io.datasets.finding import Photos

if TYPE_CHECKING:
    import pycolmap

FILE = "sfm_data.json"
LOOKED_FOR = f"OpenMVG's {FILE}"
WAY_OUT = "Run OpenMVG again."
NEW_TYPE = 1 << 31  # bit of a type's number where its name follows
RADIAL = {"pinhole": None, "pinhole_radial_k1": "disto_k1", "pinhole_radial_k3": "disto_k3"}
BROWN, FISHEYE = "pinhole_brown_t2", "fisheye"


def recognise(path: Path) -> bool:
    """Returns whether the folder holds a scene of OpenMVG."""
    return (path / FILE).is_file()


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture. Views without a pose are left out, and counted.

    Raises:
        DatasetError: if the file is damaged, or a lens model cannot be undistorted.
    """
    file = path / FILE
    contents = read_json(file)
    if not isinstance(contents, dict) or not isinstance(contents.get("views"), list):
        raise DatasetError(f"{file}: not a scene of OpenMVG. {WAY_OUT}")
    with blamed_on(file, "the scene is damaged", WAY_OUT, DatasetError):
        if len(contents["views"]) > MOST_FRAMES:
            raise too_many(file, len(contents["views"]))
        cameras = cameras_of(file, contents["intrinsics"])
        poses = {entry["key"]: entry["value"] for entry in contents["extrinsics"]}
        photos, frames = Photos(path), []
        for entry in contents["views"]:
            view = entry["value"]["ptr_wrapper"]["data"]
            if view["id_pose"] not in poses or view["id_intrinsic"] not in cameras:
                continue
            name = name_of(view)
            where = f"{file}, {shown(name)}"
            pose = pose_of(where, poses[view["id_pose"]])
            frames.append(Frame(name, photos.path_of(name, where), cameras[view["id_intrinsic"]], pose))
        points = points_of(file, contents.get("structure") or [])
    left_out = len(contents["views"]) - len(frames)
    notes = (f"{left_out} photos of {file.name} have no pose",) if left_out else ()
    return Capture(file, path, frames, points, notes=notes)


def name_of(view: dict[str, Any]) -> str:
    """Returns the name of a view's photo."""
    folder = view.get("local_path") or ""
    return (
        view["filename"]
        if folder in ("", "/", "\\")
        else (PurePosixPath(folder) / view["filename"]).as_posix()
    )


def cameras_of(file: Path, intrinsics: list[dict[str, Any]]) -> dict[int, Lens]:
    """Returns the lenses by their numbers."""
    types: dict[int, str] = {}
    cameras = {}
    for entry in intrinsics:
        value = entry["value"]
        number = value["polymorphic_id"]
        if number & NEW_TYPE:
            types[number ^ NEW_TYPE] = value["polymorphic_name"]
        kind = types[number & ~NEW_TYPE]
        where = f"{file}, intrinsic {entry['key']}"
        cameras[entry["key"]] = always(lens_of(where, kind, value["ptr_wrapper"]["data"]))
    return cameras


def lens_of(where: str, kind: str, data: dict[str, Any]) -> "pycolmap.Camera":
    """Returns the camera of an intrinsic.

    Raises:
        DatasetError: if the lens model cannot be undistorted.
    """
    if kind not in {*RADIAL, BROWN, FISHEYE}:
        raise lenses.refused(where, kind)
    base = data.get("value0", data)  # newer versions put the pinhole's numbers in an object of their own
    size, focal = (float(base["width"]), float(base["height"])), float(base["focal_length"])
    x, y = (float(number) for number in base["principal_point"])
    if kind == FISHEYE:
        k1, k2, k3, k4 = (float(k) for k in data["fisheye"])
        return lenses.fisheye(size, (focal, focal), (x, y), (k1, k2, k3, k4))
    if kind == BROWN:
        k1, k2, k3, t1, t2 = (float(k) for k in data["disto_t2"])
        return lenses.perspective(size, (focal, focal), (x, y), (k1, k2, k3), (t1, t2))
    key = RADIAL[kind]
    return lenses.perspective(size, (focal, focal), (x, y), tuple(float(k) for k in data[key]) if key else ())


def pose_of(where: str, extrinsic: dict[str, Any]) -> Float[np.ndarray, "3 4"]:
    """Returns a pose.

    Raises:
        DatasetError: if it is not a rotation and a centre.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(extrinsic["rotation"], np.float64).reshape(3, 3)
    poses, good = nearest_rigid(matrix[None])
    if not good.all():
        raise DatasetError(f"{where}: its pose is not a rotation and a centre. {WAY_OUT}")
    rotation = poses[0, :3, :3]
    return np.column_stack([rotation, -rotation @ np.array(extrinsic["center"], np.float64).reshape(3)])


def points_of(file: Path, structure: list[dict[str, Any]]) -> PointCloud:
    """Returns the points, in grey."""
    return cloud(file, np.array([entry["value"]["X"] for entry in structure], np.float64).reshape(-1, 3))
