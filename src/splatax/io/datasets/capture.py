"""The record that every reader of captures returns: photos with cameras and poses, points and depth maps."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera
from splatax.dataset import PointCloud
from splatax.errors import DatasetError

if TYPE_CHECKING:
    import pycolmap

FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: y up, z back -> y down, z forward
NO_POINTS = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))

Lens = Callable[[Path], "pycolmap.Camera"]  # of a photo, whose size is needed if the file states none


@dataclass(frozen=True)
class DepthMap:
    """Depth of each pixel of a photo; zero where it is unknown.

    It is that of the photo's lens: along the optical axis, or the distance from the camera for lenses that
    map angles.

    Attributes:
        path: 16-bit PNG, or NumPy array in a .npy file, of the photo's proportions.
        unit: world units for each unit of the file.
        confidence: 8-bit picture of the same size, black where the depth is not to be used.
    """

    path: Path
    unit: float
    confidence: Path | None = None


@dataclass(frozen=True)
class Frame:
    """One photo.

    Attributes:
        name: name of the photo in the file, with slashes.
        path: path of the photo, which may be missing.
        lens: function that returns the intrinsics of the photo.
        cam_from_world: pose, with x right, y down, z forward.
        mask: path of the mask, if the file names one.
        depth: depth map, if there is one.
        parallel: true for an orthophoto, whose focal lengths are pixels for a world unit.
        landmarks: function that returns the points of structure from motion that were observed in the photo.
        face_of: name of the 360-degree photo that this is a face of; None for a photo by itself.
    """

    name: str
    path: Path
    lens: Lens
    cam_from_world: Float[np.ndarray, "3 4"]
    mask: Path | None = None
    depth: DepthMap | None = None
    parallel: bool = False
    landmarks: Callable[[], Float[np.ndarray, "_ 3"]] | None = None
    face_of: str | None = None


@dataclass(frozen=True)
class Capture:
    """A capture as its files describe it.

    Attributes:
        source: file or folder of the poses, for messages.
        home: folder of the capture, in which all photos lie.
        frames: photos; those that are missing on the disk are left out later, and named.
        points: points of structure from motion; may be empty.
        photos: folder that the names of the frames are relative to. None for the innermost folder that holds
            all photos.
        already: factor by which the photos there have been shrunk.
        held_out: names of the frames that the capture itself holds out; None if it has no such list.
        background: background for photos with alpha; None if the capture does not define it.
        notes: lines about the capture, for people to read.
        errors: function that returns the reprojection errors of a sample of observations, in pixels of the
            view, by the view's name, given the cameras of the views.
    """

    source: Path
    home: Path
    frames: list[Frame]
    points: PointCloud = NO_POINTS
    photos: Path | None = None
    already: int = 1
    held_out: set[str] | None = None
    background: Literal["white"] | None = None
    notes: tuple[str, ...] = ()
    errors: Callable[[dict[str, Camera]], dict[str, Float[np.ndarray, " _"]]] | None = None


def always(camera: "pycolmap.Camera") -> Lens:
    """Returns the lens of photos whose size the file states."""
    return lambda photo: camera


def cloud(
    path: Path, positions: Float[np.ndarray, "n 3"], colors: Float[np.ndarray, "n 3"] | None = None
) -> PointCloud:
    """Returns points, in middle grey if they have no colours.

    Args:
        path: file of the points, for messages.
        positions: world units.
        colors: from 0 to 1.

    Raises:
        DatasetError: if a position is not finite, or a colour is not in its range.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        positions = np.asarray(positions, np.float32).reshape(-1, 3)
        shades = np.full_like(positions, 0.5) if colors is None else np.asarray(colors, np.float32)
    if not np.isfinite(positions).all():
        raise DatasetError(
            f"{path}: some points have coordinates that are not finite. Export the points again."
        )
    if not ((shades >= 0) & (shades <= 1)).all():
        raise DatasetError(f"{path}: some points have colours out of range. Export the points again.")
    return PointCloud(positions, shades.reshape(-1, 3))


def from_opengl(world_from_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3 4"]:
    """Returns world-to-camera poses from camera-to-world ones with OpenGL's axes (y up, z back)."""
    return np.linalg.inv(world_from_cam @ FROM_OPENGL)[:, :3]
