"""Reads COLMAP models, binary or text, with the photos that they were made from.

    CAPTURE/sparse/0/{cameras,images,points3D}.{bin,txt}      CAPTURE/images/...      CAPTURE/masks/...

pycolmap reads the model, and undistorts photos whose cameras are not pinholes.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatax.dataset import Dataset, PointCloud, hold_out
from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import masks, names, photos
from splatax.io.datasets.colmap_files import check_whole
from splatax.io.datasets.reprojection import reprojection_errors

if TYPE_CHECKING:
    import pycolmap

LOOKED_FOR = (
    "COLMAP's cameras, images and points3D (.bin or .txt) in sparse/0, sparse, colmap/sparse/0, "
    "distorted/sparse/0 or the folder itself"
)
MODEL_ROOTS = ("sparse", "colmap/sparse", "distorted/sparse", ".")
FILES = ("cameras", "images", "points3D")


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


def load(path: Path, *, downscale: int | None = None) -> Dataset:
    """Loads the largest model of a capture; see `load_dataset`."""
    notes = []
    models = {folder: read_model(folder) for folder in models_in(path)}
    folder, model = max(models.items(), key=lambda item: item[1].num_reg_images())
    if len(models) > 1:
        sizes = ", ".join(f"{f.name}: {m.num_reg_images()} photos" for f, m in models.items())
        notes.append(f"{len(models)} models ({sizes}); using the largest, {folder.name}")
    registered = registered_in(folder, model)
    folder, already = photos.photo_folder(path, downscale)
    found = masks.masks_of(path, registered)
    sources = [
        photos.source_of(
            name,
            photo,
            model.camera(registered[name].camera_id),
            registered[name].cam_from_world().matrix(),
            path,
            found.get(name),
        )
        for name, photo in photos_of(registered, folder).items()
    ]
    factor = photos.shrink_factor(sources, already, downscale)
    views = [source.view(factor) for source in sources]
    train, test = hold_out(views)
    points = point_cloud(path, model)

    unused = photos.unused(folder, [source.path for source in sources])
    errors = reprojection_errors(model, registered, {view.name: view.camera for view in views})
    notes.append(
        f"{len(views)} of {len(views) + len(unused)} photos registered, {len(test)} held out for testing"
    )
    notes.append(
        f"{len(points):,} points; photos {photos.sizes_of(views)} from {folder.name}/{photos.scaling(factor)}"
    )
    notes += photos.limited(sources)
    if found:
        notes.append(f"masks for {len(found)} of {len(views)} photos, from {masks.FOLDER}/")
    if errors:
        every = np.concatenate(list(errors.values()))
        notes.append(f"median reprojection error {np.median(every):.2f} px ({len(every):,} observations)")
    return Dataset(train, test, points, tuple(notes), survey=photos.survey(sources, unused, errors))


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
            return pycolmap.Reconstruction(folder)
        except Exception as error:  # its messages begin with a file and line of COLMAP's source
            raise ValueError(str(error).split("] ")[-1].strip()) from error


def registered_in(folder: Path, model: "pycolmap.Reconstruction") -> "dict[str, pycolmap.Image]":
    """Returns the registered images of a model, sorted by name.

    Raises:
        DatasetError: if there are none, a name is not valid, or two images have one name.
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
        found[name] = image
    if not found:
        raise DatasetError(f"{folder}: the model has no registered photos. Run COLMAP's mapper again.")
    return dict(sorted(found.items()))


def point_cloud(path: Path, model: "pycolmap.Reconstruction") -> PointCloud:
    """Returns the model's points.

    Raises:
        DatasetError: if a position is not finite.
    """
    points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise DatasetError(
            f"{path}: some points of the COLMAP model are at no finite place. Run COLMAP again."
        )
    colors = np.array([point.color for point in points], np.float32).reshape(-1, 3) / 255
    return PointCloud(positions, colors)


def photos_of(registered: "dict[str, pycolmap.Image]", folder: Path) -> dict[str, Path]:
    """Returns the photo of each registered image, by name.

    Raises:
        DatasetError: if a photo is missing.
    """
    found = {name: find_photo(folder, name) for name in registered}
    if missing := [name for name, path in found.items() if path is None]:
        which = "the photo is missing" if len(missing) == 1 else f"{len(missing)} photos are missing"
        also = f" ({photos.listed(missing)})" if len(missing) > 1 else ""
        raise DatasetError(
            f"{folder / missing[0]}: {which}{also}, but the COLMAP model has it registered. Put it back, or "
            "remove it from the model (colmap image_deleter)."
        )
    return {name: path for name, path in found.items() if path is not None}


def find_photo(folder: Path, name: str) -> Path | None:
    """Returns the photo of this name, or of the same name with another suffix, as resized copies may have."""
    if (folder / name).is_file():
        return folder / name
    same_stem = sorted(p for p in (folder / name).parent.glob("*") if p.stem == Path(name).stem)
    return next((p for p in same_stem if images.is_image(p)), None)
