"""COLMAP models, binary or text, and the photos they were made from.

    CAPTURE/sparse/0/{cameras,images,points3D}.{bin,txt}      CAPTURE/images/...      CAPTURE/masks/...

pycolmap reads the model, and undistorts the photos of cameras that are no pinholes.
"""

from pathlib import Path

import numpy as np
import pycolmap

from splatax.dataset import Dataset, PointCloud, hold_out
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.datasets import masks, photos
from splatax.io.datasets.colmap_files import check_whole
from splatax.io.datasets.reprojection import reprojection_errors

LOOKED_FOR = (
    "COLMAP's cameras, images and points3D (.bin or .txt) in sparse/0, sparse, colmap/sparse/0, "
    "distorted/sparse/0 or the folder itself"
)
MODEL_ROOTS = ("sparse", "colmap/sparse", "distorted/sparse", ".")
FILES = ("cameras", "images", "points3D")


def models_in(path: Path) -> list[Path]:
    """Folders that hold a whole model, in the first place that has any."""
    for root in MODEL_ROOTS:
        folder = path / root
        candidates = [folder, *sorted(p for p in folder.glob("*") if p.is_dir() and p.name.isdigit())]
        if found := [c for c in candidates if any(has_model(c, suffix) for suffix in (".bin", ".txt"))]:
            return found
    return []


def has_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}{suffix}").exists() for name in FILES)


def recognise(path: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return bool(models_in(path))


def load(path: Path, *, downscale: int | None = None) -> Dataset:
    """Loads the largest model of a capture; see `load_dataset`."""
    notes = []
    models = {folder: read_model(folder) for folder in models_in(path)}
    folder, model = max(models.items(), key=lambda item: item[1].num_reg_images())
    if len(models) > 1:
        sizes = ", ".join(f"{f.name}: {m.num_reg_images()} photos" for f, m in models.items())
        notes.append(f"{len(models)} models ({sizes}); using the largest, {folder.name}")
    registered = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    if not registered:
        raise DatasetError(f"{folder}: the model has no registered photos. Run COLMAP's mapper again.")

    folder, already = photos.photo_folder(path, downscale)
    found = masks.masks_of(path, [image.name for image in registered])
    sources = [
        photos.source_of(
            image.name,
            photo,
            model.camera(image.camera_id),
            image.cam_from_world().matrix(),
            found.get(image.name),
        )
        for image, photo in zip(registered, photos_of(registered, folder), strict=True)
    ]
    factor = photos.shrink_factor(sources, already, downscale)
    views = [source.view(factor) for source in sources]
    train, test = hold_out(views)
    points = point_cloud(model)

    unused = photos.unused(folder, [source.path for source in sources])
    errors = reprojection_errors(model, registered, {view.name: view.camera for view in views})
    notes.append(
        f"{len(views)} of {len(views) + len(unused)} photos registered, {len(test)} held out for testing"
    )
    notes.append(
        f"{len(points):,} points; photos {photos.sizes_of(views)} from {folder.name}/{photos.scaling(factor)}"
    )
    if found:
        notes.append(f"masks for {len(found)} of {len(views)} photos, from {masks.FOLDER}/")
    if errors:
        every = np.concatenate(list(errors.values()))
        notes.append(f"median reprojection error {np.median(every):.2f} px ({len(every):,} observations)")
    return Dataset(train, test, points, tuple(notes), survey=photos.survey(sources, unused, errors))


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Reads one model.

    Raises:
        DatasetError: if a file is damaged.
    """
    check_whole(folder)
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, IndexError, RuntimeError) as error:
        reason = str(error).split("] ")[-1].strip()
        raise DatasetError(
            f"{folder}: the COLMAP model is damaged ({reason}). Copy it again, or run COLMAP again."
        ) from error


def point_cloud(model: pycolmap.Reconstruction) -> PointCloud:
    """The model's points."""
    points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in points], np.float32).reshape(-1, 3) / 255
    return PointCloud(positions, colors)


def photos_of(registered: list[pycolmap.Image], folder: Path) -> list[Path]:
    """The photo of each registered image.

    Raises:
        DatasetError: if some are missing.
    """
    found = {image.name: find_photo(folder, image.name) for image in registered}
    if missing := [name for name, path in found.items() if path is None]:
        which = "the photo is missing" if len(missing) == 1 else f"{len(missing)} photos are missing"
        also = f" ({photos.listed(missing)})" if len(missing) > 1 else ""
        raise DatasetError(
            f"{folder / missing[0]}: {which}{also}, but the COLMAP model has it registered. Put it back, or "
            "remove it from the model (colmap image_deleter)."
        )
    return [path for path in found.values() if path is not None]


def find_photo(folder: Path, name: str) -> Path | None:
    """The photo of this name, or of the same name with another suffix (as resized copies have)."""
    if (folder / name).is_file():
        return folder / name
    same_stem = sorted(p for p in (folder / name).parent.glob("*") if p.stem == Path(name).stem)
    return next((p for p in same_stem if images.is_image(p)), None)
