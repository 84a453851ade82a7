"""Adjusted cameras of a capture in the folder of a run, so that the run can be resumed and repeated."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from splatax.dataset import Dataset, View
from splatax.reconstruction.calibration import Correction, corrected
from splatax.runs.records import read_record, typed, understood, write_json

AGAIN = "Start the run again."
POSES, LENSES = "poses", "lenses"


def write_cameras(path: Path, posed: Sequence[View], lenses: Mapping[str, Correction]) -> None:
    """Writes adjusted cameras to a JSON file that gives back the same bits.

    Args:
        path: of the file.
        posed: views whose `cam_from_world` is written, by name.
        lenses: corrections of the lenses of these and other views, by name. They do not depend on the size
            to which photos are shrunk.
    """
    poses = {view.name: np.asarray(view.camera.cam_from_world, np.float64).tolist() for view in posed}
    write_json(path, {POSES: poses, LENSES: {name: asdict(lens) for name, lens in lenses.items()}})


def with_cameras(dataset: Dataset, path: Path) -> Dataset:
    """Returns a capture whose views have the poses and lenses that a file has for their names.

    Raises:
        FormatError: if the file is damaged.
        FileNotFoundError: if there is none.
    """
    record = read_record(path, AGAIN)
    with understood(path, AGAIN):
        poses = typed(record[POSES], dict, POSES)
        lenses = {name: _correction(entry) for name, entry in typed(record[LENSES], dict, LENSES).items()}
        train, test = (corrected(_posed(views, poses), lenses) for views in (dataset.train, dataset.test))
        return replace(dataset, train=train, test=test)


def _correction(entry: object) -> Correction:
    values = typed(entry, dict, LENSES)
    focal, coefficients = (_numbers(values[name]) for name in ("focal", "coefficients"))
    if len(focal) != 2:
        raise TypeError(f"{len(focal)} factors on focal lengths instead of 2")
    return Correction((focal[0], focal[1]), typed(values["model"], str, "model"), coefficients)


def _numbers(values: object) -> tuple[float, ...]:
    numbers = tuple(typed(value, float, LENSES) for value in typed(values, list, LENSES))
    if not np.isfinite(numbers).all():
        raise TypeError("a lens has a number that is not finite")
    return numbers


def _posed(views: Sequence[View], poses: Mapping[str, object]) -> list[View]:
    return [_at(view, poses[view.name]) if view.name in poses else view for view in views]


def _at(view: View, rows: object) -> View:
    matrix = np.array(typed(rows, list, view.name), np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise TypeError(f"the pose of {view.name} is not a 4 x 4 matrix")
    pose = jnp.asarray(matrix, view.camera.cam_from_world.dtype)
    return replace(view, camera=replace(view.camera, cam_from_world=pose))
