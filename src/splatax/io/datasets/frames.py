"""The frames of a `transforms.json`, checked: photos, calibrated lenses and poses.

Poses are camera-to-world with OpenGL's axes (x right, y up, z back); here they become COLMAP's. The
format: https://docs.nerf.studio/quickstart/data_conventions.html
"""

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float

from splatax.errors import DatasetError
from splatax.io import images

FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, z back -> y down, z forward
RIGID_TOLERANCE = 1e-2  # of R R^T against the identity: what a printed matrix may be off
PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL"}  # all part of OPENCV
FISHEYE = "OPENCV_FISHEYE"
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Frame:
    """One photo.

    Attributes:
        name: as the file has it, with slashes, relative to the file's folder.
        path: of the photo, which may be missing.
        mask: of the mask, if it has one.
        lens: intrinsics, given the photo's size in case the file does not tell one.
        cam_from_world: with x right, y down, z forward.
    """

    name: str
    path: Path
    mask: Path | None
    lens: Callable[[tuple[int, int]], pycolmap.Camera]
    cam_from_world: Float[np.ndarray, "3 4"]


class Fields:
    """Entries of a JSON object, checked as they are read; an entry of the whole file stands in where
    a frame has none of its own. Knows where it is, for messages."""

    def __init__(self, where: str, *entries: dict[str, Any]):
        self.where = where
        self.entries = entries

    def find(self, key: str) -> Any:
        return next((entries[key] for entries in self.entries if entries.get(key) is not None), None)

    def wrong(self, key: str, expected: str) -> DatasetError:
        return DatasetError(
            f"{self.where}: {key} should be {expected}, not {shortened(self.find(key))}. "
            "Export the capture again, or correct the file."
        )

    def text(self, key: str) -> str | None:
        value = self.find(key)
        if value is not None and (not isinstance(value, str) or not value or "\0" in value):
            raise self.wrong(key, "text")
        return value

    def number(self, key: str) -> float | None:
        value = self.find(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.wrong(key, "a finite number")
        return float(value)

    def positive(self, key: str) -> float | None:
        value = self.number(key)
        if value is not None and value <= 0:
            raise self.wrong(key, "a number above zero")
        return value

    def rigid(self, key: str) -> Float[np.ndarray, "4 4"] | None:
        """A rotation and a translation, 3 x 4 or 4 x 4."""
        value = self.find(key)
        if value is None:
            return None
        try:
            matrix = np.array(value, np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
            raise self.wrong(key, "a 4 x 4 matrix of finite numbers")
        rotation = matrix[:3, :3]
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if off > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
            raise self.wrong(key, "a rotation and a translation, without scale or mirroring")
        left, _, right = np.linalg.svd(rotation)  # the nearest rotation
        return np.vstack([np.column_stack([left @ right, matrix[:3, 3]]), [0, 0, 0, 1]])


def shortened(value: Any) -> str:
    return text if len(text := repr(value)) <= 60 else text[:57] + "..."


def read(path: Path) -> dict[str, Any]:
    """The contents of the file, of which only its outermost form is checked.

    Raises:
        DatasetError: if it is not JSON, or has no list of frames.
    """
    try:
        contents = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not valid JSON ({error}). Export the capture again.") from error
    frames = contents.get("frames") if isinstance(contents, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise DatasetError(f'{path}: it has no list of "frames", so no poses. Export the capture again.')
    return contents


def frames_of(path: Path, contents: dict[str, Any]) -> list[Frame]:
    """The frames, in the order of the file.

    Raises:
        DatasetError: if an entry is missing, of the wrong kind, or leads out of the file's folder; or if
            a photo occurs twice.
    """
    frames = [frame_of(path, i, entries, contents) for i, entries in enumerate(contents["frames"])]
    names = [frame.name for frame in frames]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise DatasetError(f"{path}: {twice[0]} is the photo of two frames. Remove one of them.")
    return frames


def frame_of(path: Path, index: int, entries: dict[str, Any], contents: dict[str, Any]) -> Frame:
    """One frame; what it lacks in intrinsics it takes from the whole file."""
    own = Fields(f"{path}, frame {index}", entries)
    either = Fields(own.where, entries, contents)
    name, pose = own.text("file_path"), own.rigid("transform_matrix")
    if name is None or pose is None:
        missing = "file_path" if name is None else "transform_matrix"
        raise DatasetError(
            f"{own.where}: it has no {missing}. Export the capture again, or remove the frame."
        )
    photo = inside(path.parent, name, own.where)
    if not images.is_image(photo):  # Blender's are named without their suffix
        photo = photo.with_name(photo.name + ".png")
    mask = own.text("mask_path")
    return Frame(
        photo.relative_to(path.parent).as_posix(),
        photo,
        inside(path.parent, mask, own.where) if mask else None,
        lambda size: lens_of(either, size),
        np.linalg.inv(pose @ FROM_OPENGL)[:3],
    )


def inside(folder: Path, name: str, where: str) -> Path:
    """The file of this name in a folder.

    Raises:
        DatasetError: if the name leads elsewhere.
    """
    relative = PurePosixPath(name.replace("\\", "/"))
    if relative.is_absolute() or ".." in relative.parts or ":" in relative.as_posix():
        raise DatasetError(
            f"{where}: {shortened(name)} leads out of the capture's folder. Move the photos into it, and "
            "name them relative to it."
        )
    return folder / relative


def lens_of(fields: Fields, size: tuple[int, int]) -> pycolmap.Camera:
    """The camera of a frame, at the size that its intrinsics are for: the photo's if that is not told.

    Raises:
        DatasetError: if there is no focal length, or the model of the lens is unknown.
    """
    width, height = fields.positive("w") or float(size[0]), fields.positive("h") or float(size[1])
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
    pinhole = [fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy]
    k1, k2, k3, k4, p1, p2 = (fields.number(key) or 0.0 for key in DISTORTION)
    model = fields.text("camera_model") or (FISHEYE if fields.find("is_fisheye") else "OPENCV")
    if model == FISHEYE:
        return camera(FISHEYE, width, height, [*pinhole, k1, k2, k3, k4])
    if model not in PERSPECTIVE:
        raise fields.wrong("camera_model", f"one of {', '.join(sorted(PERSPECTIVE))} or {FISHEYE}")
    if k4:
        raise fields.wrong("k4", "zero for a lens that is no fisheye")
    if k3:
        return camera("FULL_OPENCV", width, height, [*pinhole, k1, k2, p1, p2, k3, 0, 0, 0])
    return camera("OPENCV", width, height, [*pinhole, k1, k2, p1, p2])


def focal_of(angle: float | None, side: float) -> float | None:
    """Pixels, from the field of view along a side."""
    return 0.5 * side / math.tan(angle / 2) if angle else None


def camera(model: str, width: float, height: float, parameters: list[float]) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=round(width), height=round(height), params=parameters)
