"""Motions of cameras during the exposure, in a file beside a capture: COLMAP's cameras have none.

    CAPTURE/motions.json      {"photo.jpg": [rx, ry, rz, tx, ty, tz], ...}

The six numbers of a photo are its `RollingShutter.twist`: radians, and world units. Rows are exposed from the
top to the bottom. A photo that is exposed in another direction has {"direction": "left", "twist": [...]}.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import jax.numpy as jnp
import numpy as np

from splatax.cameras import RollingShutter
from splatax.cameras.motion import Direction
from splatax.dataset import View
from splatax.errors import DatasetError, shown
from splatax.io.datasets import names
from splatax.io.datasets.fields import read_json
from splatax.io.datasets.photos import counted

FILE = "motions.json"


def contents_for(views: Iterable[View]) -> dict[str, Any]:
    """Returns the contents of the file: the motion of each view whose camera moves, by name."""
    found: dict[str, Any] = {}
    for view in views:
        if (motion := view.camera.motion) is not None:
            twist = np.asarray(motion.twist, np.float64).tolist()
            down = motion.direction == "down"
            found[view.name] = twist if down else {"direction": motion.direction, "twist": twist}
    return found


def read(capture: Path) -> dict[str, RollingShutter]:
    """Returns the motions of photos by name; none if there is no file.

    Raises:
        DatasetError: if the file is damaged.
    """
    path = capture / FILE
    if not path.is_file():
        return {}
    contents = read_json(names.confined(path, capture))
    if not isinstance(contents, dict):
        raise DatasetError(f"{path}: not the motions of photos by name. Export it again, or remove it.")
    return {name: _motion(path, name, entry) for name, entry in contents.items()}


def _motion(path: Path, name: str, entry: Any) -> RollingShutter:
    described = entry if isinstance(entry, dict) else {"direction": "down", "twist": entry}
    direction: Any = described.get("direction")
    try:
        twist = np.array(described.get("twist"), np.float32)
    except (TypeError, ValueError, OverflowError):
        twist = np.zeros(0, np.float32)
    if twist.shape != (6,) or not np.isfinite(twist).all() or direction not in get_args(Direction):
        raise DatasetError(
            f"{path}: the motion of {shown(name)} is not six finite numbers, with a direction of "
            f"{', '.join(get_args(Direction))}. Export it again, or remove it."
        )
    return RollingShutter(jnp.asarray(twist), direction)


def moving(
    views: Iterable[View], motions: Mapping[str, RollingShutter], resampled: set[str]
) -> tuple[list[View], tuple[str, ...]]:
    """Returns views whose cameras move as they did, and notes about them.

    Args:
        views: as the capture describes them.
        motions: of photos by name. A note counts the names that no view has.
        resampled: names of undistorted photos. Their rows are not those that were exposed together, so their
            cameras stand still.
    """
    found, count = [], 0
    for view in views:
        moves = view.name in motions and view.name not in resampled
        count += moves
        found.append(replace(view, camera=replace(view.camera, motion=motions[view.name])) if moves else view)
    notes = [f"rolling shutter of {counted(count)}, from {FILE}"] if count else []
    if unknown := len(motions.keys() - {view.name for view in found}):
        notes.append(f"{FILE} names {counted(unknown)} that the capture does not have")
    if still := len(resampled & motions.keys()):
        notes.append(f"the motion of {counted(still)} is not used, because they are undistorted")
    return found, tuple(notes)
