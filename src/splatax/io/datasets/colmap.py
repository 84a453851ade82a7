"""Reads COLMAP models, binary or text, with the photos that they were made from.

    CAPTURE/sparse/0/{cameras,images,points3D}.{bin,txt}      CAPTURE/images/...      CAPTURE/masks/...

pycolmap reads the model, and undistorts photos whose cameras are not pinholes.
"""

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.dataset import PointCloud
from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import names, photos
from splatax.io.datasets.capture import Capture, Frame, always
from splatax.io.datasets.colmap_files import check_whole, names_with_spaces
from splatax.io.datasets.reprojection import reprojection_errors

if TYPE_CHECKING:
    import pycolmap

LOOKED_FOR = "COLMAP's cameras, images and points3D (.bin or .txt) in sparse/0 or the folder itself"
MODEL_ROOTS = ("sparse", "colmap/sparse", "distorted/sparse", ".")
FILES = ("cameras", "images", "points3D")
ROUNDED = 0.01  # by which the length of a rotation's quaternion in a text model may differ from 1


def models_in(path: Path) -> list[Path]:
    """Returns the folders that hold a complete model, from the first of `MODEL_ROOTS` that has any."""
    for root in MODEL_ROOTS:
        folder = path / root
        candidates = [folder, *sorted(p for p in folder.glob("*") if p.is_dir() and p.name.isdigit())]
        if found := [c for c in candidates if any(has_model(c, suffix) for suffix in (".bin", ".txt"))]:
            return found
    return []


def has_model(folder: Path, suffix: str) -> bool:
    """Returns whether a folder holds all files of a model with this suffix."""
    return all((folder / f"{name}{suffix}").exists() for name in FILES)


def recognise(path: Path) -> bool:
    """Returns whether the folder holds a COLMAP model."""
    return bool(models_in(path))


def read(path: Path, downscale: int | None) -> Capture:
    """Reads the largest model of a capture, with the photos of the folder that fits the factor."""
    models = {folder: read_model(folder) for folder in models_in(path)}
    folder, model = max(models.items(), key=lambda item: item[1].num_reg_images())
    notes: tuple[str, ...] = ()
    if len(models) > 1:
        sizes = ", ".join(f"{f.name}: {m.num_reg_images()} photos" for f, m in models.items())
        notes = (f"{len(models)} models ({sizes}); using the largest, {folder.name}",)
    registered = registered_in(folder, model)
    folder, already = photos.photo_folder(path, downscale)
    faces = faces_of(model, registered)
    frames = [
        Frame(
            name,
            photo,
            always(model.camera(registered[name].camera_id)),
            registered[name].cam_from_world().matrix(),
            landmarks=partial(points_observed, model, registered[name]),
            face_of=faces.get(name),
        )
        for name, photo in photos_of(registered, folder).items()
    ]
    return Capture(
        path,
        path,
        frames,
        point_cloud(path, model),
        photos=folder,
        already=already,
        notes=notes,
        errors=partial(reprojection_errors, model, registered),
    )


def read_model(folder: Path) -> "pycolmap.Reconstruction":
    """Reads one model.

    Raises:
        DatasetError: if a file is damaged.
    """
    import pycolmap

    check_whole(folder)
    way_out = "Copy it again, or run COLMAP again."
    with blamed_on(folder, "the COLMAP model is damaged", way_out, DatasetError):
        try:
            model = pycolmap.Reconstruction(folder)
        except Exception as error:  # its messages begin with a file and line of COLMAP's source
            raise ValueError(str(error).split("] ")[-1].strip()) from error
        for number, name in names_with_spaces(folder).items():
            model.image(number).name = name
        return model


def registered_in(folder: Path, model: "pycolmap.Reconstruction") -> "dict[str, pycolmap.Image]":
    """Returns the registered images of a model, sorted by name.

    Raises:
        DatasetError: if there are none, a name is not valid, two images have one name, or a rotation is not
            a unit quaternion.
    """
    found: dict[str, pycolmap.Image] = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        try:
            name = image.name
        except UnicodeDecodeError as error:
            readable = shown(error.object.decode(errors="backslashreplace"))
            raise DatasetError(
                f"{folder}: the photo name {readable} is not UTF-8. "
                "Rename the photo with plain letters, and run COLMAP again."
            ) from error
        name = names.checked(name, folder)
        if name in found:
            raise DatasetError(
                f"{folder}: two images of the model have the name {shown(name)}. Remove one of them "
                "(colmap image_deleter)."
            )
        length = np.linalg.norm(image.cam_from_world().rotation.quat)
        if abs(length - 1) > ROUNDED:
            raise DatasetError(
                f"{folder}: the rotation of {shown(name)} is a quaternion of length {length:.3g}, not 1. "
                "Correct it, or run COLMAP's mapper again."
            )
        found[name] = image
    if not found:
        raise DatasetError(f"{folder}: the model has no registered photos. Run COLMAP's mapper again.")
    return dict(sorted(found.items()))


def faces_of(model: "pycolmap.Reconstruction", registered: "dict[str, pycolmap.Image]") -> dict[str, str]:
    """Returns the 360-degree photo of each image that is a face of one, by the image's name.

    Faces are the images of one moment (a frame) by the cameras of a rig that share an optical centre. What
    their names begin with in common is the name of the photo.
    """
    turning = {
        number
        for number, rig in model.rigs.items()
        if len(rig.non_ref_sensors)
        and all(pose and not np.any(pose.translation) for pose in rig.non_ref_sensors.values())
    }
    moments: dict[int, list[str]] = {}
    for name, image in registered.items():
        if image.frame and image.frame.rig_id in turning:
            moments.setdefault(image.frame_id, []).append(name)
    found: dict[str, str] = {}
    for faces in moments.values():
        photo = os.path.commonprefix(faces).rstrip("-_./ ") or faces[0]  # noqa: RUF071
        if photo in found.values():  # rigs of other programs may name cameras first
            photo = faces[0]
        found |= dict.fromkeys(faces, photo)
    return found


def point_cloud(path: Path, model: "pycolmap.Reconstruction") -> PointCloud:
    """Returns the model's points.

    Raises:
        DatasetError: if a position is not finite.
    """
    points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise DatasetError(
            f"{path}: some points of the COLMAP model have coordinates that are not finite. Run COLMAP again."
        )
    colors = np.array([point.color for point in points], np.float32).reshape(-1, 3) / 255
    return PointCloud(positions, colors)


def points_observed(model: "pycolmap.Reconstruction", image: "pycolmap.Image") -> Float[np.ndarray, "_ 3"]:
    """Returns the points that the model says are seen in an image."""
    observed = (point.point3D_id for point in image.get_observation_points2D())
    points = [model.point3D(number).xyz for number in observed if model.exists_point3D(number)]
    return np.array(points, np.float32).reshape(-1, 3)


def photos_of(registered: "dict[str, pycolmap.Image]", folder: Path) -> dict[str, Path]:
    """Returns the photo of each registered image, by name.

    Raises:
        DatasetError: if a photo is missing.
    """
    found = {name: find_photo(folder, name) for name in registered}
    if missing := [name for name, path in found.items() if path is None]:
        which, them = "the photo is missing", "it"
        if len(missing) > 1:
            which, them = f"{len(missing)} photos are missing ({photos.listed(missing)})", "them"
        raise DatasetError(
            f"{folder / missing[0]}: {which}, but the COLMAP model has {them} registered. Put {them} back, "
            f"or remove {them} from the model (colmap image_deleter)."
        )
    return {name: path for name, path in found.items() if path is not None}


def find_photo(folder: Path, name: str) -> Path | None:
    """Returns the photo of this name, or of the same name with another suffix, as resized copies may have."""
    if (folder / name).is_file():
        return folder / name
    same_stem = sorted(p for p in (folder / name).parent.glob("*") if p.stem == Path(name).stem)
    return next((p for p in same_stem if images.is_image(p) and p.is_file()), None)
