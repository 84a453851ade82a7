"""JSON files of keyframes, written by hand or saved by the live viewer."""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera
from splatax.errors import FormatError
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
        rows, closed = contents["keyframes"], bool(contents.get("closed", False))
        keys = [_key(row) for row in rows]
        times = _times(rows, closed)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise FormatError(f"{path}: not a camera path: {reason}. docs/video.md shows one.") from error
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


def _key(row: dict[str, Any]) -> Keyframe:
    position, wxyz = (np.array(row[name], np.float64) for name in ("position", "wxyz"))
    fov = float(row["fov"])
    if position.shape != (3,) or wxyz.shape != (4,) or not np.isfinite([*position, *wxyz]).all():
        raise ValueError("position has 3 numbers, wxyz has 4")
    if not 0 < fov < 180:
        raise ValueError(f"fov is an angle of 0 to 180 degrees, not {fov}")
    return Keyframe(position, Rotation.from_quat(wxyz, scalar_first=True), np.radians(fov))


def _times(rows: list[dict[str, Any]], closed: bool) -> list[float]:
    if not rows:
        raise ValueError("no keyframes")
    timed = [row["seconds"] for row in rows if "seconds" in row]
    if not timed:
        return [float(i) for i in range(len(rows) + closed)]
    times = [float(seconds) for seconds in timed]
    if len(times) != len(rows) or any(a >= b for a, b in itertools.pairwise(times)):
        raise ValueError("seconds increase from each keyframe to the next, and all have them or none")
    return [*times, times[-1] + (times[-1] - times[0]) / max(len(times) - 1, 1)] if closed else times
