"""Writes cameras and points as a COLMAP model, which `colmap.load` can read."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatax.cameras import Camera, to_colmap
from splatax.dataset import PointCloud, View

if TYPE_CHECKING:
    import pycolmap

PLACE = Path("sparse/0")  # folder of the model, in the folder of a capture


def save(folder: Path, views: Iterable[View], points: PointCloud) -> None:
    """Writes FOLDER/sparse/0/{cameras,images,points3D}.bin, replacing files that exist.

    The photos are not written. Points have no observations. Views with equal intrinsics share one COLMAP
    camera.

    Args:
        folder: folder of a capture.
        views: views whose cameras are written.
        points: points to write; their colours are rounded to 8 bits.
    """
    import pycolmap

    model = model_of_cameras((view.name, view.camera) for view in views)
    colors = np.clip(np.round(points.colors * 255), 0, 255).astype(np.uint8)
    for position, color in zip(points.positions.astype(np.float64), colors, strict=True):
        model.add_point3D(position, pycolmap.Track(), color)
    place = folder / PLACE
    place.mkdir(parents=True, exist_ok=True)
    model.write_binary(place)


def colmap_camera(camera: Camera) -> "pycolmap.Camera":
    """Returns COLMAP's camera; it cannot hold a motion during the exposure."""
    import pycolmap

    model, numbers = to_colmap(replace(camera, motion=None))
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=numbers)


def model_of_cameras(
    cameras: Iterable[tuple[str, Camera]],
    calibrated: "Callable[[Camera], pycolmap.Camera]" = colmap_camera,
) -> "pycolmap.Reconstruction":
    """Returns a COLMAP model of named cameras, without points.

    Images are numbered from 1 in the given order. Cameras with equal intrinsics share one COLMAP camera.

    Args:
        cameras: with their names.
        calibrated: function that returns COLMAP's camera for one of them.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    numbers: dict[tuple[float, ...], int] = {}
    for number, (name, camera) in enumerate(cameras, start=1):
        lens = calibrated(camera)
        key = (lens.model.value, lens.width, lens.height, *lens.params)
        if key not in numbers:
            lens.camera_id = numbers[key] = len(numbers) + 1
            model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=name, camera_id=numbers[key], image_id=number)
        model.add_image_with_trivial_frame(image, _pose(camera))
    return model


def _pose(camera: Camera) -> "pycolmap.Rigid3d":
    """Returns the nearest exactly rigid pose; products of float32 matrices are only nearly rigid."""
    import pycolmap

    left, _, right = np.linalg.svd(np.asarray(camera.rotation, np.float64))
    translation = np.asarray(camera.translation, np.float64)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(left @ right), translation)
