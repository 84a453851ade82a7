"""Adjusted poses of training photos in the folder of a run, so that the run can be resumed and repeated."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from splatax.dataset import Dataset, View
from splatax.runs.records import read_record, typed, understood, write_json

AGAIN = "Start the run again."


def write_poses(path: Path, views: Sequence[View]) -> None:
    """Writes `cam_from_world` of each view, by name, to a JSON file that gives back the same bits."""
    write_json(
        path, {view.name: np.asarray(view.camera.cam_from_world, np.float64).tolist() for view in views}
    )


def with_poses(dataset: Dataset, path: Path) -> Dataset:
    """Returns a capture whose training views have the poses of a file. Held-out views keep theirs.

    Raises:
        FormatError: if the file is damaged, or lacks a training view.
        FileNotFoundError: if there is none.
    """
    poses = read_record(path, AGAIN)
    with understood(path, AGAIN):
        train = tuple(_posed(view, poses[view.name]) for view in dataset.train)
    return replace(dataset, train=train)


def _posed(view: View, rows: object) -> View:
    matrix = np.array(typed(rows, list, view.name), np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise TypeError(f"the pose of {view.name} is not a 4 x 4 matrix")
    pose = jnp.asarray(matrix, view.camera.cam_from_world.dtype)
    return replace(view, camera=replace(view.camera, cam_from_world=pose))
