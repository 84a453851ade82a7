"""Writes cameras and points as a COLMAP model, which `colmap.load` can read."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera, to_colmap
from splatax.dataset import PointCloud, View, by_photo

if TYPE_CHECKING:
    import pycolmap

PLACE = Path("sparse/0")  # folder of the model, in the folder of a capture
SAME_TURN = (
    1e-4  # greatest difference of entries of two rotation matrices that are the same in single precision
)


def save(folder: Path, views: Iterable[View], points: PointCloud) -> None:
    """Writes FOLDER/sparse/0/{cameras,images,points3D}.bin, replacing files that exist.

    The photos are not written. Points have no observations. Views with equal intrinsics share one COLMAP
    camera. The faces of 360-degree photos are written as a rig, so they are one photo again when they are
    read; each rig has cameras of its own, as COLMAP wants it.

    Args:
        folder: folder of a capture.
        views: views whose cameras are written.
        points: points to write; their colours are rounded to 8 bits.
    """
    import pycolmap

    views = tuple(views)
    model = model_of_cameras((view.name, view.camera) for view in views if view.face_of is None)
    faces = [view for view in views if view.face_of is not None]
    add_faces(model, by_photo(faces, {view.name: view for view in faces}).values())
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
        key = _key(lens)
        if key not in numbers:
            lens.camera_id = numbers[key] = len(numbers) + 1
            model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=name, camera_id=numbers[key], image_id=number)
        model.add_image_with_trivial_frame(image, _pose(camera))
    return model


@dataclass(frozen=True)
class RigOfFaces:
    """A rig in the model.

    Attributes:
        number: of the rig.
        cameras: of its faces, in COLMAP's form, with their numbers; the first is the rig itself.
        turns: face_from_rig of each.
    """

    number: int
    cameras: "Sequence[pycolmap.Camera]"
    turns: Float[np.ndarray, "faces 3 3"]

    def fits(self, faces: Sequence[View]) -> bool:
        """Returns whether a photo's faces have the lenses and the rotations of the rig."""
        if len(faces) != len(self.cameras):
            return False
        lenses = (_key(colmap_camera(face.camera)) for face in faces)
        return all(_key(ours) == theirs for ours, theirs in zip(self.cameras, lenses, strict=True)) and bool(
            np.allclose(self.turns, turns_of(faces), atol=SAME_TURN)
        )


def add_faces(model: "pycolmap.Reconstruction", photos: Iterable[Sequence[View]]) -> None:
    """Adds 360-degree photos to a model, as frames of a rig for each arrangement of faces.

    Args:
        model: with images and frames that are numbered from 1 together.
        photos: the faces of each, which have one optical centre.
    """
    import pycolmap

    rigs: list[RigOfFaces] = []
    number = model.num_images()
    for faces in photos:
        rig = next((rig for rig in rigs if rig.fits(faces)), None)
        if rig is None:
            rig = add_rig(model, faces)
            rigs.append(rig)
        frame = pycolmap.Frame(frame_id=number + 1, rig_id=rig.number)
        frame.rig_from_world = _pose(faces[0].camera)
        images = []
        for face, camera in zip(faces, rig.cameras, strict=True):
            number += 1
            image = pycolmap.Image(name=face.name, camera_id=camera.camera_id, image_id=number)
            image.frame_id = frame.frame_id
            frame.add_data_id(image.data_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame.frame_id)


def add_rig(model: "pycolmap.Reconstruction", faces: Sequence[View]) -> RigOfFaces:
    """Adds a rig with the lenses and the rotations of a photo's faces to a model."""
    import pycolmap

    first = max(model.cameras, default=0) + 1
    cameras, turns = [colmap_camera(face.camera) for face in faces], turns_of(faces)
    rig = pycolmap.Rig(rig_id=max(model.rigs, default=0) + 1)
    for number, (camera, turn) in enumerate(zip(cameras, turns, strict=True), start=first):
        camera.camera_id = number
        model.add_camera(camera)
        if number == first:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3)))
    model.add_rig(rig)
    return RigOfFaces(rig.rig_id, cameras, turns)


def turns_of(faces: Sequence[View]) -> Float[np.ndarray, "faces 3 3"]:
    """Returns the rotations of a photo's faces relative to the first one."""
    poses = [_rotation(face.camera) for face in faces]
    return np.stack([pose @ poses[0].T for pose in poses])


def _key(camera: "pycolmap.Camera") -> tuple[float, ...]:
    return tuple(map(float, (camera.model.value, camera.width, camera.height, *camera.params)))


def _rotation(camera: Camera) -> Float[np.ndarray, "3 3"]:
    left, _, right = np.linalg.svd(np.asarray(camera.rotation, np.float64))
    return left @ right


def _pose(camera: Camera) -> "pycolmap.Rigid3d":
    """Returns the nearest exactly rigid pose; products of float32 matrices are only nearly rigid."""
    import pycolmap

    translation = np.asarray(camera.translation, np.float64)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(_rotation(camera)), translation)
