"""Poses of photos in a JSON file.

    {"poses": {"fist":  {"rotations": {"index-1": [x, y, z, w]}, "translations": {"wrist": [x, y, z]}},
               "later": {"clip": "Wave", "time": 0.5}},
     "photos": {"view00.png": "fist", "view01.png": "later"}}

Rotations, translations and scales are those of glTF's nodes, in the frame of the parent. Joints that a pose
does not name are as in the rest pose, or as in the clip.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError, shown
from splatax.io.files import write_whole
from splatax.io.formats.untrusted import structured
from splatax.scene.clips import Clip
from splatax.scene.skeleton import Pose, Skeleton
from splatax.shapes import is_number

FIELDS = {"rotations": ("quats", 4), "translations": ("translations", 3), "scales": ("scales", 3)}


@dataclass(frozen=True)
class Posing:
    """Poses by name, and the name of the pose in each photo."""

    poses: dict[str, Pose]
    pose_of: dict[str, str]


def read_poses(path: Path, skeleton: Skeleton, clips: Mapping[str, Clip]) -> Posing:
    """Reads the poses of the photos of a capture.

    Raises:
        FormatError: if the file is missing or not JSON, or names a joint, clip or pose that is not there.
    """
    try:
        contents = json.loads(path.read_text(encoding="utf-8"))
        written, photos = dict(contents["poses"]), dict(contents["photos"])
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file. Give a clip, or a .json file of poses.") from None
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(
            f'{path}: not a file of poses: it needs "poses" and "photos" '
            f"({type(error).__name__}). docs/rigs.md shows one."
        ) from error
    with structured(path, "poses"):
        poses = {str(name): _pose(path, str(name), pose, skeleton, clips) for name, pose in written.items()}
        for photo, name in photos.items():
            if name not in poses:
                raise FormatError(
                    f"{path}: {shown(photo)} has the pose {shown(str(name))}, which is not in it. Add the "
                    "pose."
                )
    return Posing(poses, photos)


def along_clip(clip: Clip, rest: Pose, photos: list[str]) -> Posing:
    """Returns poses at equal steps of time over a clip, one for each photo, in their order."""
    times = np.linspace(0, clip.seconds, len(photos))
    poses = {photo: clip.pose(rest, float(time)) for photo, time in zip(photos, times, strict=True)}
    return Posing(poses, {photo: photo for photo in photos})


def write_poses(path: Path, posing: Posing, skeleton: Skeleton) -> None:
    """Writes poses with the transforms of all joints; see `read_poses`."""
    poses = {
        name: {
            "rotations": _listed(skeleton, np.asarray(pose.quats)[:, [1, 2, 3, 0]]),
            "translations": _listed(skeleton, np.asarray(pose.translations)),
            "scales": _listed(skeleton, np.asarray(pose.scales)),
        }
        for name, pose in posing.poses.items()
    }
    write_whole(path, json.dumps({"poses": poses, "photos": posing.pose_of}, indent=1).encode())


def _listed(skeleton: Skeleton, rows: np.ndarray) -> dict[str, list[float]]:
    return {name: [float(v) for v in row] for name, row in zip(skeleton.names, rows, strict=True)}


def _pose(path: Path, name: str, written: Any, skeleton: Skeleton, clips: Mapping[str, Clip]) -> Pose:
    if not isinstance(written, dict):
        raise FormatError(f"{path}: the pose {shown(name)} has neither rotations nor a clip.")
    known = ("clip", "time", *FIELDS)
    if unknown := [key for key in written if key not in known]:
        raise FormatError(
            f"{path}: the pose {shown(name)} has {shown(unknown[0])}, which is not one of {', '.join(known)}."
        )
    pose = skeleton.rest
    if (clip := written.get("clip")) is not None:
        if clip not in clips:
            raise FormatError(
                f"{path}: the pose {shown(name)} names the clip {shown(str(clip))}, which the body does not "
                f"have. Its clips are {shown(', '.join(clips) or 'none', 300)}."
            )
        time = written.get("time", 0)
        if not is_number(time):
            raise FormatError(
                f"{path}: time of the pose {shown(name)} is {shown(repr(time))}, not a number of seconds."
            )
        pose = clips[clip].pose(pose, float(time))
    for key, (attribute, width) in FIELDS.items():
        for joint, numbers in dict(written.get(key, {})).items():
            if joint not in skeleton.names:
                listed = shown(", ".join(skeleton.names), 300)
                raise FormatError(
                    f"{path}: the pose {shown(name)} moves {shown(joint)}, which is no joint of the body. "
                    f"Its joints are {listed}."
                )
            row = np.asarray(numbers, np.float64)
            if row.shape != (width,) or not np.isfinite(row).all() or (not row.any() and key == "rotations"):
                raise FormatError(
                    f"{path}: {key} of {shown(joint)} in the pose {shown(name)}: {width} numbers, in a "
                    "rotation not all zero."
                )
            row = row[[3, 0, 1, 2]] if width == 4 else row
            values = getattr(pose, attribute)
            changed = values.at[skeleton.names.index(joint)].set(jnp.asarray(row, values.dtype))
            pose = replace(pose, **{attribute: changed})
    return pose
