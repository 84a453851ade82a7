"""Reads `transforms.json` of nerfstudio and instant-ngp, and `transforms_train.json` of Blender's scenes.

CAPTURE/transforms.json              CAPTURE/images/...
CAPTURE/transforms_train.json        CAPTURE/train/...      CAPTURE/transforms_test.json ...
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.dataset import PointCloud
from splatax.errors import DatasetError, shown
from splatax.io.datasets import frames, names
from splatax.io.datasets.capture import NO_POINTS, Capture, Frame
from splatax.io.datasets.fields import Fields
from splatax.io.datasets.points import cloud_of_ply

WHOLE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
LOOKED_FOR = f"{WHOLE} (nerfstudio, instant-ngp) or {TRAIN} (Blender)"
SPLITS = ("train_filenames", "test_filenames", "val_filenames")  # nerfstudio's keys for the split


def recognise(path: Path) -> bool:
    """Returns whether the folder holds frames in JSON."""
    return (path / WHOLE).is_file() or (path / TRAIN).is_file()


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture. Blender's files define the held-out photos themselves."""
    if (path / WHOLE).is_file():
        contents = frames.read(path / WHOLE)
        found = frames.frames_of(path / WHOLE, contents)
        tested = named_test(path / WHOLE, contents, found)
        world = Fields(f"{path / WHOLE}", contents).rigid("applied_transform")
        if world is not None:  # it was applied to the poses after reconstruction, and is undone here
            found = [replace(frame, cam_from_world=frame.cam_from_world @ world) for frame in found]
        points = points_of(path / WHOLE, contents, world)
        return Capture(path / WHOLE, path, found, points, held_out=tested)
    found = frames.frames_of(path / TRAIN, frames.read(path / TRAIN))
    tested = None
    if (path / TEST).is_file():
        held_out = frames.frames_of(path / TEST, frames.read(path / TEST))
        tested = {frame.name for frame in held_out}
        if both := sorted(tested & {frame.name for frame in found}):
            raise DatasetError(f"{path / TEST}: {both[0]} is in {TRAIN} too. Hold out other photos.")
        found += held_out
    # White is the convention of these scenes, in training and evaluation.
    return Capture(path / TRAIN, path, found, held_out=tested, background="white")


def named_test(path: Path, contents: dict[str, Any], found: list[Frame]) -> set[str] | None:
    """Returns the names of the photos that the file holds out; None if it has no split.

    Raises:
        DatasetError: if the split names a photo that no frame has.
    """
    names = {frame.name for frame in found}
    split: dict[str, set[str]] = {}
    for key in SPLITS:
        listed = contents.get(key) or []
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise Fields(f"{path}", contents).wrong(key, "a list of photos")
        split[key] = {PurePosixPath(name.replace("\\", "/")).as_posix() for name in listed}
        if strange := sorted(split[key] - names):
            raise DatasetError(
                f"{path}: {key} names {shown(strange[0])}, which no frame has. Correct the list."
            )
    tested = split["test_filenames"] or split["val_filenames"]
    return tested or (names - split["train_filenames"] if split["train_filenames"] else None) or None


def points_of(path: Path, contents: dict[str, Any], world: Float[np.ndarray, "4 4"] | None) -> PointCloud:
    """Returns the points of the PLY file that the capture names; an empty cloud if it names none.

    Raises:
        DatasetError: if the PLY file is missing, damaged, or holds no coloured points.
    """
    name = Fields(f"{path}", contents).text("ply_file_path")
    if name is None:
        return NO_POINTS
    ply = path.parent / names.checked(name, f"{path}, ply_file_path")
    way_out = f"{path.name} names it as its ply_file_path. Put the right file there, or remove that line."
    if not ply.is_file():
        raise DatasetError(f"{ply}: no such file, but {way_out}")
    points = cloud_of_ply(names.confined(ply, path.parent), way_out)
    if world is None:
        return points
    positions = (points.positions.astype(np.float64) - world[:3, 3]) @ world[:3, :3]
    return replace(points, positions=positions.astype(np.float32))
