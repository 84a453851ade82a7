"""Reads Polycam's raw data, with its depth maps as points.

    CAPTURE/keyframes/corrected_cameras/ID.json    else keyframes/cameras/ID.json
    CAPTURE/keyframes/corrected_images/ID.jpg     else keyframes/images/ID.jpg
    CAPTURE/keyframes/depth/ID.png                   16 bits, millimetres
    CAPTURE/keyframes/confidence/ID.png              8 bits, black where the depth is not to be trusted

t_00 to t_23 are the rows of the camera-to-world matrix, with OpenGL's axes of the camera and y up.
(github.com/PolyCam/polyform: README.md)
"""

from pathlib import Path

import numpy as np

from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, DepthMap, Frame, always, from_opengl
from splatax.io.datasets.fields import MOST_FRAMES, Fields, nearest_rigid, read_json, too_many

LOOKED_FOR = "Polycam's keyframes/ of raw data"
KEYFRAMES = "keyframes"
KINDS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
MILLIMETRES = 1e-3


def recognise(path: Path) -> bool:
    """Returns whether the folder holds cameras of Polycam."""
    return any(any((path / KEYFRAMES / cameras).glob("*.json")) for cameras, _ in KINDS)


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture, with the cameras that Polycam has corrected if there are any.

    Raises:
        DatasetError: if the file of a camera is damaged.
    """
    cameras, photos = next(
        (path / KEYFRAMES / cameras, path / KEYFRAMES / photos)
        for cameras, photos in KINDS
        if any((path / KEYFRAMES / cameras).glob("*.json"))
    )
    files = sorted(cameras.glob("*.json"))
    if len(files) > MOST_FRAMES:
        raise too_many(cameras, len(files))
    by_stem = {photo.stem: photo for photo in sorted(photos.glob("*")) if images.is_image(photo)}
    frames = [frame_of(file, by_stem.get(file.stem, photos / f"{file.stem}.jpg")) for file in files]
    return Capture(cameras, path, frames)


def frame_of(file: Path, photo: Path) -> Frame:
    """Returns the frame of a camera's file.

    Raises:
        DatasetError: if the file is damaged, or an entry of it is missing.
    """
    contents = read_json(file)
    if not isinstance(contents, dict):
        raise DatasetError(f"{file}: not a camera of Polycam. Export the raw data again.")
    fields = Fields(f"{file}", contents)
    matrix = np.eye(4)
    matrix[:3] = [[required(fields, f"t_{row}{column}") for column in range(4)] for row in range(3)]
    poses, good = nearest_rigid(matrix[None])
    if not good.all():
        raise DatasetError(
            f"{file}: its pose is not a rotation and a translation. Export the raw data again."
        )
    width, height = fields.side("width"), fields.side("height")
    if width is None or height is None:
        raise missing(fields, "width" if width is None else "height")
    focal = required(fields, "fx"), required(fields, "fy")
    centre = required(fields, "cx"), required(fields, "cy")
    keyframes = file.parent.parent
    return Frame(
        photo.name,
        photo,
        always(lenses.perspective((width, height), focal, centre)),
        from_opengl(poses)[0],
        depth=DepthMap(
            keyframes / "depth" / f"{file.stem}.png",
            MILLIMETRES,
            keyframes / "confidence" / f"{file.stem}.png",
        ),
    )


def required(fields: Fields, key: str) -> float:
    """Returns a number that must be there."""
    if (value := fields.number(key)) is None:
        raise missing(fields, key)
    return value


def missing(fields: Fields, key: str) -> DatasetError:
    """Returns the error about a number that is not there."""
    return DatasetError(f"{fields.where}: it has no {key}. Export the raw data again.")
