"""Reads `transforms.json` of nerfstudio and instant-ngp, and `transforms_train.json` of Blender's scenes.

CAPTURE/transforms.json              CAPTURE/images/...
CAPTURE/transforms_train.json        CAPTURE/train/...      CAPTURE/transforms_test.json ...
"""

import os
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.dataset import Dataset, PointCloud, View, hold_out
from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import frames, masks, names, photos
from splatax.io.datasets.frames import Fields, Frame
from splatax.io.formats import ply_table

WHOLE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
LOOKED_FOR = f"{WHOLE} (nerfstudio, instant-ngp) or {TRAIN} (Blender)"
SPLITS = ("train_filenames", "test_filenames", "val_filenames")  # nerfstudio's keys for the split


def recognise(path: Path) -> bool:
    """Returns whether the folder holds frames in JSON."""
    return (path / WHOLE).is_file() or (path / TRAIN).is_file()


def load(path: Path, *, downscale: int | None = None) -> Dataset:
    """Loads a capture; see `load_dataset`. Blender's files define the held-out photos themselves."""
    if (path / WHOLE).is_file():
        contents = frames.read(path / WHOLE)
        found = frames.frames_of(path / WHOLE, contents)
        tested = named_test(path / WHOLE, contents, found)
        world = Fields(f"{path / WHOLE}", contents).rigid("applied_transform")
        return dataset_of(path / WHOLE, found, tested, downscale, contents, world)
    found = frames.frames_of(path / TRAIN, frames.read(path / TRAIN))
    tested = None
    if (path / TEST).is_file():
        held_out = frames.frames_of(path / TEST, frames.read(path / TEST))
        tested = {frame.name for frame in held_out}
        if both := sorted(tested & {frame.name for frame in found}):
            raise DatasetError(f"{path / TEST}: {both[0]} is in {TRAIN} too. Hold out other photos.")
        found += held_out
    dataset = dataset_of(path / TRAIN, found, tested, downscale, {}, None)
    return replace(dataset, background="white")  # the convention of these scenes, in training and evaluation


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


def dataset_of(
    path: Path,
    found: list[Frame],
    tested: set[str] | None,
    downscale: int | None,
    contents: dict[str, Any],
    world: Float[np.ndarray, "4 4"] | None,
) -> Dataset:
    """Returns the dataset of the given frames.

    Args:
        path: path of the file, for messages and for the files beside it.
        found: frames of the capture.
        tested: names of the photos that are held out; None for every 8th.
        downscale: see `load_dataset`.
        contents: contents of the file, which may name a file of points.
        world: transform that was applied to the poses after reconstruction, and is undone here.
    """
    present: list[Frame] = []
    missing: list[Frame] = []
    for frame in found:
        (present if os.path.isfile(frame.path) else missing).append(frame)
    if not present:
        raise DatasetError(
            f"{path}: none of its {len(found)} photos is there; the first should be {found[0].path}. "
            "Put them where the file says."
        )
    folder = Path(os.path.commonpath([frame.path.parent for frame in present]))
    named = {frame.path.relative_to(folder).as_posix(): frame for frame in present}
    beside = {} if any(frame.mask for frame in present) else masks.masks_of(path.parent, named)
    sources = [
        photos.source_of(
            name,
            frame.path,
            frame.lens(upright_size(frame.path)),
            frame.cam_from_world if world is None else frame.cam_from_world @ world,
            path.parent,
            frame.mask or beside.get(name),
        )
        for name, frame in sorted(named.items())
    ]
    factor = photos.shrink_factor(sources, 1, downscale)
    views = [source.view(factor) for source in sources]
    train, test = hold_out(views) if tested is None else parted(path, views, named, tested)
    points = points_of(path, contents, world)
    unused = photos.unused(folder, [source.path for source in sources]) if folder != path.parent else ()
    notes = [f"{len(views)} photos with poses, {len(test)} held out for testing"]
    if missing:
        lacking = photos.listed(frame.name for frame in missing)
        notes.append(f"{len(missing)} of {len(found)} frames have no photo: {lacking}")
    notes.append(f"{len(points):,} points; photos {photos.sizes_of(views)}{photos.scaling(factor)}")
    notes += photos.limited(sources)
    if count := sum(source.mask is not None for source in sources):
        notes.append(f"masks for {count} of {len(views)} photos")
    return Dataset(train, test, points, tuple(notes), survey=photos.survey(sources, unused, {}))


def upright_size(path: Path) -> tuple[int, int]:
    """Returns the width and height of a photo after its EXIF orientation is applied."""
    return images.size_of(path, upright=True)


def parted(
    path: Path, views: list[View], named: dict[str, Frame], tested: set[str]
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Returns (train, test) views, as the capture's split defines them.

    Raises:
        DatasetError: if no view is left to train on.
    """
    test = tuple(view for view in views if named[view.name].name in tested)
    train = tuple(view for view in views if named[view.name].name not in tested)
    if not train:
        raise DatasetError(
            f"{path}: all photos that are there are held out. Put those to train on beside it."
        )
    return train, test


def points_of(path: Path, contents: dict[str, Any], world: Float[np.ndarray, "4 4"] | None) -> PointCloud:
    """Returns the points of the PLY file that the capture names; an empty cloud if it names none.

    Raises:
        DatasetError: if the PLY file is missing, damaged, or holds no coloured points.
    """
    name = Fields(f"{path}", contents).text("ply_file_path")
    if name is None:
        return PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    ply = path.parent / names.checked(name, f"{path}, ply_file_path")
    way_out = f"{path.name} names it as its ply_file_path. Put the right file there, or remove that line."
    if not ply.is_file():
        raise DatasetError(f"{ply}: no such file, but {way_out}")
    with blamed_on(ply, "no coloured points can be read from it", way_out, DatasetError):
        vertex = ply_table.read(names.confined(ply, path.parent)).elements["vertex"]
        columns = [vertex[c].astype(np.float64) for c in ("x", "y", "z", "red", "green", "blue")]
    positions, colors = np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1)
    if not np.isfinite(positions).all():
        raise DatasetError(f"{ply}: some points are at no finite place. Export the points again.")
    if world is not None:
        positions = (positions - world[:3, 3]) @ world[:3, :3]
    scale = 255 if vertex["red"].dtype.kind == "u" else 1
    return PointCloud(positions.astype(np.float32), (colors / scale).astype(np.float32))
