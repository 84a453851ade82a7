"""JSON files of keyframes, written by hand or saved by the live viewer."""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera
from splatax.errors import FormatError
from splatax.shapes import is_number
from splatax.trajectories.interpolation import Keyframe, Size, interpolate


def read(path: Path, frames: int, size: Size) -> list[Camera]:
    """Reads a file of keyframes and interpolates them to a number of frames.

    The file is {"closed": false, "keyframes": [{"position": [x, y, z], "wxyz": [w, x, y, z], "fov":
    degrees, "seconds": s}, ...]}. wxyz rotates camera axes (x right, y down, z forward) to world axes, and
    fov is the vertical field of view. "seconds" sets the relative timing; if no keyframe has it,
    keyframes are evenly spaced. A closed trajectory returns to its first keyframe.

    Args:
        path: the JSON file.
        frames: number of cameras to return.
        size: width and height of the frames, pixels.

    Raises:
        FormatError: if the file is missing or is not a file of keyframes.
    """
    try:
        contents = json.loads(path.read_text())
    except FileNotFoundError:
        raise FormatError(
            f"{path}: no such file. A camera path is orbit, spiral, interpolate or a .json file of keyframes."
        ) from None
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: not a JSON file ({error}). Save the path again.") from error
    try:
        rows, closed = _rows(contents), bool(contents.get("closed", False))
        keys = [_key(row, f"keyframe {i}") for i, row in enumerate(rows, 1)]
        times = _times(rows, closed)
    except ValueError as error:
        raise FormatError(f"{path}: not a camera path: {error}. docs/video.md shows one.") from error
    moments = np.linspace(times[0], times[-1], frames, endpoint=not closed)
    return [key.camera(size) for key in interpolate(keys, times, moments, closed=closed)]


def write(keys: Sequence[Keyframe]) -> bytes:
    """Returns the contents of a JSON file with these keyframes."""
    rows = [
        {
            "position": [float(x) for x in key.position],
            "wxyz": [float(q) for q in key.rotation.as_quat(scalar_first=True)],
            "fov": float(np.degrees(key.fov)),
        }
        for key in keys
    ]
    return json.dumps({"closed": False, "keyframes": rows}, indent=1).encode()


def _rows(contents: Any) -> list[Any]:
    if not isinstance(contents, dict) or "keyframes" not in contents:
        raise ValueError("'keyframes' is missing")
    rows = contents["keyframes"]
    if not isinstance(rows, list) or not rows:
        raise ValueError("no keyframes in a list")
    return rows


def _key(row: Any, where: str) -> Keyframe:
    if not isinstance(row, dict):
        raise ValueError(f"{where} is {row!r}, not position, wxyz and fov")
    position, wxyz, fov = _numbers(row, where, "position", 3), _numbers(row, where, "wxyz", 4), row.get("fov")
    if not np.any(wxyz):
        raise ValueError(f"{where}: wxyz is zero, which is no rotation")
    if not is_number(fov) or not 0 < fov < 180:
        raise ValueError(f"{where}: fov is an angle of 0 to 180 degrees, not {fov}")
    return Keyframe(position, Rotation.from_quat(wxyz, scalar_first=True), np.radians(float(fov)))


def _numbers(row: dict[str, Any], where: str, name: str, count: int) -> Float[np.ndarray, " count"]:
    if name not in row:
        raise ValueError(f"{where}: {name!r} is missing")
    values = row[name]
    if not isinstance(values, list) or len(values) != count or not all(map(is_number, values)):
        raise ValueError(f"{where}: {name} is {values!r}, not {count} numbers")
    return np.array(values, np.float64)


def _times(rows: list[dict[str, Any]], closed: bool) -> list[float]:
    timed = [row["seconds"] for row in rows if "seconds" in row]
    if not timed:
        return [float(i) for i in range(len(rows) + closed)]
    if len(timed) != len(rows) or not all(map(is_number, timed)):
        raise ValueError("seconds are numbers, and all keyframes have them or none")
    times = [float(seconds) for seconds in timed]
    if any(a >= b for a, b in itertools.pairwise(times)):
        raise ValueError("seconds increase from each keyframe to the next")
    return [*times, times[-1] + (times[-1] - times[0]) / max(len(times) - 1, 1)] if closed else times
