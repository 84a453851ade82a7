"""Reads recordings of Record3D, exported as pictures with a `metadata.json`.

    CAPTURE/metadata.json    CAPTURE/rgb/0.jpg, 1.jpg, ...    CAPTURE/depth/0.png or 0.npy (optional)

The entries may also be in a folder EXR_RGBD/. `poses` are camera-to-world as (qx, qy, qz, qw, x, y, z), with
OpenGL's axes of the camera and y up. `K` is stored by columns; `perFrameIntrinsicCoeffs`, if present, are
(fx, fy, cx, cy) of each frame. Depth is read from 16-bit pictures in millimetres and from arrays in metres.
Record3D's own .exr and .depth files are not read. (record3d.app/features; github.com/marek-simonik/record3d)
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, DepthMap, Frame, always, from_opengl
from splatax.io.datasets.fields import MOST_FRAMES, Fields, nearest_rigid, read_json, too_many

FILE = "metadata.json"
LOOKED_FOR = f"Record3D's {FILE} and rgb/"
FOLDERS = ("", "EXR_RGBD")
MILLIMETRES, METRES = 1e-3, 1.0
WAY_OUT = "Export the recording again."


def recognise(path: Path) -> bool:
    """Returns whether the folder holds a recording."""
    return home_of(path) is not None


def home_of(path: Path) -> Path | None:
    """Returns the folder with the file and the photos."""
    folders = (path / folder for folder in FOLDERS)
    return next((f for f in folders if (f / FILE).is_file() and (f / "rgb").is_dir()), None)


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a recording.

    Raises:
        DatasetError: if the file is damaged.
    """
    home = home_of(path)
    assert home is not None
    file = home / FILE
    contents = read_json(file)
    if not isinstance(contents, dict):
        raise DatasetError(f"{file}: not metadata of Record3D. {WAY_OUT}")
    fields = Fields(f"{file}", contents)
    width, height = fields.side("w"), fields.side("h")
    if width is None or height is None:
        raise DatasetError(f"{file}: it has no w and h, the size of the photos. {WAY_OUT}")
    poses = poses_of(fields)
    lens = lenses_of(fields, len(poses))
    photos = {p.stem: p for p in sorted((home / "rgb").iterdir()) if images.is_image(p)}
    frames = []
    for i, (pose, (fx, fy, cx, cy)) in enumerate(zip(poses, lens, strict=True)):
        photo = photos.get(str(i), home / "rgb" / f"{i}.jpg")
        camera = lenses.perspective((width, height), (fx, fy), (cx, cy))
        frames.append(Frame(photo.name, photo, always(camera), pose, depth=depth_of(home / "depth", i)))
    notes: tuple[str, ...] = ()
    if (home / "depth").is_dir() and not any(frame.depth for frame in frames):
        notes = (f"the depth maps in {home.name}/depth are not read: convert them to 16-bit .png or .npy",)
    return Capture(file, path, frames, notes=notes)


def poses_of(fields: Fields) -> Float[np.ndarray, "n 3 4"]:
    """Returns the poses of all frames.

    Raises:
        DatasetError: if there are none, or one is not valid.
    """
    from scipy.spatial.transform import Rotation

    rows = table(fields, "poses", 7)
    if not len(rows):
        raise DatasetError(f"{fields.where}: it has no poses. {WAY_OUT}")
    if len(rows) > MOST_FRAMES:
        raise too_many(Path(fields.where), len(rows))
    with np.errstate(all="ignore"):
        if not np.isfinite(rows).all() or not (np.linalg.norm(rows[:, :4], axis=1) > 0).all():
            raise fields.wrong("poses", "quaternions and positions of finite numbers")
        matrices = np.tile(np.eye(4), (len(rows), 1, 1))
        matrices[:, :3, :3] = Rotation.from_quat(rows[:, :4]).as_matrix()
        matrices[:, :3, 3] = rows[:, 4:]
    poses, good = nearest_rigid(matrices)
    if not good.all():
        raise fields.wrong("poses", "quaternions and positions of finite numbers")
    return from_opengl(poses)


def lenses_of(fields: Fields, count: int) -> Float[np.ndarray, "n 4"]:
    """Returns the focal lengths and principal point of each frame, pixels.

    Raises:
        DatasetError: if there are none, or their number is not that of the poses.
    """
    if fields.find("perFrameIntrinsicCoeffs"):
        rows = table(fields, "perFrameIntrinsicCoeffs", 4)
        if len(rows) != count:
            raise DatasetError(
                f"{fields.where}: {count} poses, but perFrameIntrinsicCoeffs of {len(rows)} frames. {WAY_OUT}"
            )
        return rows
    if fields.find("K") is None:
        raise DatasetError(
            f"{fields.where}: no focal length: neither K nor perFrameIntrinsicCoeffs. {WAY_OUT}"
        )
    with blamed_on(Path(fields.where), "its K is not 9 numbers", WAY_OUT, DatasetError):
        matrix = np.array(fields.find("K"), np.float64).reshape(3, 3).T
    return np.tile([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], (count, 1))


def table(fields: Fields, key: str, columns: int) -> Float[np.ndarray, "n columns"]:
    """Returns an entry that holds rows of numbers."""
    value: Any = fields.find(key)
    with blamed_on(Path(fields.where), f"its {key} are not rows of {columns} numbers", WAY_OUT, DatasetError):
        return np.array([] if value is None else value, np.float64).reshape(-1, columns)


def depth_of(folder: Path, number: int) -> DepthMap | None:
    """Returns the depth map of a frame, if there is one that can be read."""
    if (folder / f"{number}.png").is_file():
        return DepthMap(folder / f"{number}.png", MILLIMETRES)
    if (folder / f"{number}.npy").is_file():
        return DepthMap(folder / f"{number}.npy", METRES)
    return None
