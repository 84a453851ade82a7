"""Reads and checks the frames of a `transforms.json`: photos, calibrated lenses and poses.

Poses in the file are camera-to-world with OpenGL's axes (x right, y up, z back). They are converted to
COLMAP's convention. Format: https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from splatax.cameras.conventions import PANORAMA
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.datasets import lenses, names
from splatax.io.datasets.capture import DepthMap, Frame, from_opengl
from splatax.io.datasets.fields import MOST_FRAMES, Fields, matrices_of, nearest_rigid, read_json, too_many

if TYPE_CHECKING:
    import pycolmap

PERSPECTIVE = {
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "OPENCV",
    "RADIAL",
    "SIMPLE_RADIAL",
}  # all are special cases of OPENCV
FISHEYE = "OPENCV_FISHEYE"
PARALLEL = "ORTHOPHOTO"  # its focal lengths are pixels for a world unit
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
MILLIMETRES = 1e-3  # unit of depth maps, unless the file says another


def read(path: Path) -> dict[str, Any]:
    """Reads the file and checks only that it has a list of frames.

    Raises:
        DatasetError: if it is not JSON, has no list of frames, or has more than `MOST_FRAMES`.
    """
    contents = read_json(path, 2 * MOST_FRAMES)
    frames = contents.get("frames") if isinstance(contents, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise DatasetError(f'{path}: it has no list of "frames", so no poses. Export the capture again.')
    if len(frames) > MOST_FRAMES:
        raise too_many(path, len(frames))
    return contents


def frames_of(path: Path, contents: dict[str, Any]) -> list[Frame]:
    """Returns the frames in the order of the file.

    Raises:
        DatasetError: if an entry is missing, has the wrong type or leads out of the file's folder, or if a
            photo occurs twice.
    """
    entries = contents["frames"]
    poses = poses_of(path, entries)
    found: dict[str, Frame] = {}
    for i, (own, pose) in enumerate(zip(entries, poses, strict=True)):
        frame = frame_of(path, Fields(f"{path}, frame {i}", own, contents), own, pose)
        if frame.name in found:
            raise DatasetError(f"{path}: {frame.name} is the photo of two frames. Remove one of them.")
        found[frame.name] = frame
    return list(found.values())


def poses_of(path: Path, entries: list[dict[str, Any]]) -> Float[np.ndarray, "n 3 4"]:
    """Returns the world-to-camera poses of all frames.

    Raises:
        DatasetError: if a pose is missing or is not rigid. The message names its frame.
    """
    matrices = matrices_of([entry.get("transform_matrix") for entry in entries])
    poses, good = (None, np.zeros(1, bool)) if matrices is None else nearest_rigid(matrices)
    if (
        poses is None or not good.all()
    ):  # one by one: to find the wrong one, or because 3 x 4 and 4 x 4 are mixed
        every = []
        for i, entry in enumerate(entries):
            fields = Fields(f"{path}, frame {i}", entry)
            if (pose := fields.rigid("transform_matrix")) is None:
                raise missing(fields, "transform_matrix")
            every.append(pose)
        poses = np.stack(every)
    return from_opengl(poses)


def frame_of(
    path: Path, fields: Fields, entries: dict[str, Any], cam_from_world: Float[np.ndarray, "3 4"]
) -> Frame:
    """Returns one frame.

    Args:
        path: path of the file.
        fields: entries of the frame, and of the whole file for those that the frame lacks.
        entries: entries of the frame only.
        cam_from_world: pose of the frame.
    """
    own = Fields(fields.where, entries)
    name, mask, depth = own.text("file_path"), own.text("mask_path"), own.text("depth_file_path")
    if name is None:
        raise missing(own, "file_path")
    name = names.checked(name, own.where)
    if not name.lower().endswith(tuple(images.SUFFIXES)):  # Blender's files omit the suffix
        name += ".png"
    unit = fields.positive("depth_unit_scale_factor") or MILLIMETRES
    return Frame(
        name,
        path.parent / name,
        lambda photo: lens_of(fields, images.size_of(photo, upright=True)),
        cam_from_world,
        path.parent / names.checked(mask, own.where) if mask else None,
        DepthMap(path.parent / names.checked(depth, own.where), unit) if depth else None,
        parallel=fields.text("camera_model") == PARALLEL,
    )


def missing(fields: Fields, key: str) -> DatasetError:
    """Returns the error about a frame that lacks a required entry."""
    return DatasetError(f"{fields.where}: it has no {key}. Export the capture again, or remove the frame.")


def lens_of(fields: Fields, size: tuple[int, int]) -> "pycolmap.Camera":
    """Returns the camera of a frame at the size in the file, or at the photo's size if the file has none.

    Raises:
        DatasetError: if there is no focal length, or the camera model is unknown.
    """
    width, height = fields.side("w") or float(size[0]), fields.side("h") or float(size[1])
    model = fields.text("camera_model") or (FISHEYE if fields.find("is_fisheye") else "OPENCV")
    if model == PANORAMA:
        return lenses.camera(PANORAMA, (width, height), [width, height])
    fx = fields.positive("fl_x") or focal_of(fields.positive("camera_angle_x"), width)
    vertical = None if fields.find("fl_x") else focal_of(fields.positive("camera_angle_y"), height)
    fy = fields.positive("fl_y") or vertical
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise DatasetError(
            f"{fields.where}: no focal length: neither fl_x nor camera_angle_x, in the frame or the file. "
            "Export the capture again."
        )
    cx, cy = fields.number("cx"), fields.number("cy")
    centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    k1, k2, k3, k4, p1, p2 = (fields.number(key) or 0.0 for key in DISTORTION)
    if model == FISHEYE:
        return lenses.fisheye((width, height), (fx, fy), centre, (k1, k2, k3, k4))
    if model not in {*PERSPECTIVE, PARALLEL}:
        known = sorted([*PERSPECTIVE, FISHEYE, PANORAMA])
        raise fields.wrong("camera_model", f"one of {', '.join(known)} or {PARALLEL}")
    if model == PARALLEL and any((k1, k2, k3, p1, p2)):
        raise fields.wrong("k1", "zero, like all other distortion, for an orthophoto")
    if k4:
        raise fields.wrong("k4", "zero for a lens that is no fisheye")
    return lenses.perspective((width, height), (fx, fy), centre, (k1, k2, k3), (p1, p2))


def focal_of(angle: float | None, side: float) -> float | None:
    """Returns the focal length in pixels from the field of view along a side."""
    return 0.5 * side / math.tan(angle / 2) if angle else None
