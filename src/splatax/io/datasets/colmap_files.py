"""Reads what pycolmap does not read of COLMAP's files.

pycolmap reads past the end of a truncated binary file: it returns garbage, or never returns. The check here
therefore steps over the records by their lengths, without reading their contents. Of text files, pycolmap
reads the name of a photo up to its first space.
"""

import struct
from pathlib import Path

from splatax.errors import DatasetError

# Number of parameters of each camera model, by COLMAP's model number.
CAMERA_PARAMETERS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)))

POSE = 56  # bytes: a quaternion and a translation


def check_whole(model: Path) -> None:
    """Checks the binary files of a model that are present; `rigs` and `frames` exist in newer versions.

    Raises:
        DatasetError: if a file is shorter or longer than its own counts say.
    """
    for name, end_of_record in ENDS.items():
        path = model / f"{name}.bin"
        if not path.exists():
            continue
        contents = path.read_bytes()
        try:
            (count,) = struct.unpack_from("<Q", contents)
            end = 8
            for _ in range(count):
                end = end_of_record(contents, end)
                if end > len(contents):
                    raise struct.error
        except (struct.error, ValueError, KeyError):
            end = -1
        if end != len(contents):
            raise DatasetError(
                f"{path}: damaged: its {len(contents):,} bytes do not hold what it announces. "
                "Copy it again from where it was made, or run COLMAP again."
            )


def names_with_spaces(model: Path) -> dict[int, str]:
    """Returns the names of photos that have spaces, by the number of the image; none of a binary model."""
    path = model / "images.txt"
    if (model / "images.bin").exists() or not path.exists():
        return {}
    found = {}
    with path.open(encoding="utf-8", errors="surrogateescape") as lines:
        for line in lines:
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            number, *_, name = line.strip().split(None, 9)
            if len(name.split()) > 1:
                found[int(number)] = name
            next(lines, None)  # the observations, which may be an empty line
    return found


def _end_of_camera(contents: bytes, start: int) -> int:
    (model,) = struct.unpack_from("<i", contents, start + 4)
    return start + 24 + 8 * CAMERA_PARAMETERS[model]


def _end_of_image(contents: bytes, start: int) -> int:
    name_end = contents.index(b"\0", start + 64)
    (observations,) = struct.unpack_from("<Q", contents, name_end + 1)
    return name_end + 9 + 24 * observations


def _end_of_point(contents: bytes, start: int) -> int:
    (track,) = struct.unpack_from("<Q", contents, start + 43)
    return start + 51 + 8 * track


def _end_of_rig(contents: bytes, start: int) -> int:
    (sensors,) = struct.unpack_from("<I", contents, start + 4)
    end = start + 8 + (8 if sensors else 0)  # the reference sensor, which has no pose of its own
    for _ in range(sensors - 1):
        (has_pose,) = struct.unpack_from("<8xB", contents, end)
        end += 9 + (POSE if has_pose else 0)
    return end


def _end_of_frame(contents: bytes, start: int) -> int:
    (images,) = struct.unpack_from("<I", contents, start + 8 + POSE)
    return start + 12 + POSE + 16 * images


ENDS = {
    "rigs": _end_of_rig,
    "cameras": _end_of_camera,
    "frames": _end_of_frame,
    "images": _end_of_image,
    "points3D": _end_of_point,
}
