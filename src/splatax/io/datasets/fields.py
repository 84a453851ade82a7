"""Entries of JSON files that are checked when they are read, and matrices that should be rigid."""

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from splatax.errors import DatasetError, shown
from splatax.io.damage import blamed_on
from splatax.io.datasets.photos import LARGEST_CAMERA

RIGID_TOLERANCE = 1e-2  # of R R^T against the identity; allows for rounding of printed matrices
MOST_FRAMES = 200_000  # as many as an archive may hold files; more take minutes to read


def read_json(path: Path, most_objects: int | None = None) -> Any:
    """Reads a JSON file.

    Args:
        path: path of the file.
        most_objects: number of JSON objects above which the file is refused before it is parsed.

    Raises:
        DatasetError: if it is not JSON, or holds more objects.
    """
    with blamed_on(path, "not valid JSON", "Export the capture again.", DatasetError):
        text = path.read_bytes()
        # Each frame is a JSON object. Objects are counted before a gigabyte is parsed.
        if most_objects is not None and (objects := text.count(b"{")) > most_objects:
            raise too_many(path, objects)
        return json.loads(text.decode("utf-8-sig"))  # some editors put a byte order mark before the text


def too_many(path: Path, count: int) -> DatasetError:
    """Returns the error about a file with more frames than a capture can have."""
    return DatasetError(f"{path}: {count:,} frames, and at most {MOST_FRAMES:,} are read. Split the capture.")


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
