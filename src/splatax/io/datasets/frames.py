"""Reads and checks the frames of a `transforms.json`: photos, calibrated lenses and poses.

Poses in the file are camera-to-world with OpenGL's axes (x right, y up, z back). They are converted to
COLMAP's convention. Format: https://docs.nerf.studio/quickstart/data_conventions.html
"""

import json
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from splatax.errors import DatasetError, shown
from splatax.io.damage import blamed_on
from splatax.io.datasets import names
from splatax.io.datasets.photos import LARGEST_CAMERA
from splatax.io.images import SUFFIXES

if TYPE_CHECKING:
    import pycolmap

FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, z back -> y down, z forward
RIGID_TOLERANCE = 1e-2  # of R R^T against the identity; allows for rounding of printed matrices
PERSPECTIVE = {
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "OPENCV",
    "RADIAL",
    "SIMPLE_RADIAL",
}  # all are special cases of OPENCV
FISHEYE = "OPENCV_FISHEYE"
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
MOST_FRAMES = 200_000  # as many as an archive may hold files; more take minutes to read


@dataclass(frozen=True)
class Frame:
    """One photo.

    Attributes:
        name: name of the photo in the file, with slashes, relative to the file's folder.
        path: path of the photo, which may be missing.
        mask: path of the mask, if the frame has one.
        lens: returns the intrinsics, given the photo's size in case the file does not state it.
        cam_from_world: pose, with x right, y down, z forward.
    """

    name: str
    path: Path
    mask: Path | None
    lens: "Callable[[tuple[int, int]], pycolmap.Camera]"
    cam_from_world: Float[np.ndarray, "3 4"]


class Fields:
    """Entries of JSON objects that are checked when they are read.

    An entry is looked up in the frame first and then in the whole file. Error messages name the location.
    """

    def __init__(self, where: str, *entries: dict[str, Any]):
        self.where = where
        self.entries = entries

    def find(self, key: str) -> Any:
        """Returns the entry from the first object that has it; None if none has it."""
        for entries in self.entries:
            if (value := entries.get(key)) is not None:
                return value
        return None

    def wrong(self, key: str, expected: str) -> DatasetError:
        """Returns the error about an entry that has the wrong type or value."""
        return DatasetError(
            f"{self.where}: {key} should be {expected}, not {shortened(self.find(key))}. "
            "Export the capture again, or correct the file."
        )

    def text(self, key: str) -> str | None:
        """Returns the entry as a non-empty string."""
        value = self.find(key)
        if value is not None and (not isinstance(value, str) or not value):
            raise self.wrong(key, "text")
        return value

    def number(self, key: str) -> float | None:
        """Returns the entry as a finite number."""
        value = self.find(key)
        if value is None:
            return None
        number = math.inf
        if isinstance(value, int | float) and not isinstance(value, bool):
            with suppress(OverflowError):  # whole numbers in JSON may have any length
                number = float(value)
        if not math.isfinite(number):
            raise self.wrong(key, "a finite number")
        return number

    def positive(self, key: str) -> float | None:
        """Returns the entry as a finite number greater than zero."""
        value = self.number(key)
        if value is not None and value <= 0:
            raise self.wrong(key, "a number above zero")
        return value

    def side(self, key: str) -> float | None:
        """Returns the entry as the side of a photo, pixels."""
        value = self.positive(key)
        if value is not None and not 0.5 < value <= LARGEST_CAMERA:
            raise self.wrong(key, "a number of pixels")
        return value

    def rigid(self, key: str) -> Float[np.ndarray, "4 4"] | None:
        """Returns the entry, a 3 x 4 or 4 x 4 matrix, as the nearest exactly rigid transform."""
        value = self.find(key)
        if value is None:
            return None
        matrix = matrices_of([value])
        if matrix is None or not np.isfinite(matrix).all():
            raise self.wrong(key, "a 4 x 4 matrix of finite numbers")
        poses, good = nearest_rigid(matrix)
        if not good.all():
            raise self.wrong(key, "a rotation and a translation, without scale or mirroring")
        return poses[0]


def matrices_of(values: list[Any]) -> Float[np.ndarray, "n r 4"] | None:
    """Returns 3 x 4 or 4 x 4 matrices in JSON as one array; None if they are anything else."""
    try:
        matrices = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return matrices if matrices.ndim == 3 and matrices.shape[1:] in ((3, 4), (4, 4)) else None


def nearest_rigid(
    matrices: Float[np.ndarray, "n r 4"],
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"]]:
    """Returns the nearest exactly rigid transforms, and a mask of the matrices that are close to them."""
    good = np.isfinite(matrices).all((1, 2))
    matrices = np.where(good[:, None, None], matrices, np.eye(4)[: matrices.shape[1]])
    rotations = matrices[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
        good &= (off <= RIGID_TOLERANCE) & (np.linalg.det(rotations) > 0)
    left, _, right = np.linalg.svd(np.where(good[:, None, None], rotations, np.eye(3)))
    poses = np.tile(np.eye(4), (len(matrices), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = left @ right, matrices[:, :3, 3]
    return poses, good


def shortened(value: Any) -> str:
    """Returns an entry in a short form for messages."""
    return shown(repr(value) if not isinstance(value, int) or abs(value) < 10**60 else "a huge number", 60)


def read(path: Path) -> dict[str, Any]:
    """Reads the file and checks only that it has a list of frames.

    Raises:
        DatasetError: if it is not JSON, has no list of frames, or has more than `MOST_FRAMES`.
    """
    with blamed_on(path, "not valid JSON", "Export the capture again.", DatasetError):
        text = path.read_bytes()
        # Each frame is a JSON object. Objects are counted before a gigabyte is parsed.
        if (objects := text.count(b"{")) > 2 * MOST_FRAMES:
            raise too_many(path, objects)
        contents = json.loads(text.decode("utf-8-sig"))  # some editors put a byte order mark before the text
    frames = contents.get("frames") if isinstance(contents, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise DatasetError(f'{path}: it has no list of "frames", so no poses. Export the capture again.')
    if len(frames) > MOST_FRAMES:
        raise too_many(path, len(frames))
    return contents


def too_many(path: Path, count: int) -> DatasetError:
    """Returns the error about a file with more frames than a capture can have."""
    return DatasetError(f"{path}: {count:,} frames, and at most {MOST_FRAMES:,} are read. Split the capture.")


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
    return np.linalg.inv(poses @ FROM_OPENGL)[:, :3]


def frame_of(
    path: Path, fields: Fields, entries: dict[str, Any], cam_from_world: Float[np.ndarray, "3 4"]
) -> Frame:
    """Returns one frame.

    Args:
        path: path of the file.
        fields: entries of the frame, and of the whole file for those that the frame lacks.
        entries: entries of the frame alone.
        cam_from_world: pose of the frame.
    """
    own = Fields(fields.where, entries)
    name, mask = own.text("file_path"), own.text("mask_path")
    if name is None:
        raise missing(own, "file_path")
    name = names.checked(name, own.where)
    if not name.lower().endswith(tuple(SUFFIXES)):  # Blender's files omit the suffix
        name += ".png"
    return Frame(
        name,
        path.parent / name,
        path.parent / names.checked(mask, own.where) if mask else None,
        lambda size: lens_of(fields, size),
        cam_from_world,
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
    """Returns the focal length in pixels from the field of view along a side."""
    return 0.5 * side / math.tan(angle / 2) if angle else None


def camera(model: str, width: float, height: float, parameters: list[float]) -> "pycolmap.Camera":
    """Returns a COLMAP camera."""
    import pycolmap

    return pycolmap.Camera(model=model, width=round(width), height=round(height), params=parameters)
