"""COLMAP models, binary or text, and the photos they were made from.

    CAPTURE/sparse/0/{cameras,images,points3D}.{bin,txt}      CAPTURE/images/...      CAPTURE/masks/...

pycolmap reads the model, and undistorts the photos of cameras that are no pinholes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pycolmap
from jaxtyping import Float

from splatax.camera import Camera
from splatax.dataset import Dataset, Pixels, PointCloud, View, hold_out
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.datasets import masks
from splatax.io.datasets.colmap_files import check_whole
from splatax.io.datasets.reprojection import reprojection_errors

LOOKED_FOR = (
    "COLMAP's cameras, images and points3D (.bin or .txt) in sparse/0, sparse, colmap/sparse/0, "
    "distorted/sparse/0 or the folder itself"
)
MODEL_ROOTS = ("sparse", "colmap/sparse", "distorted/sparse", ".")
FILES = ("cameras", "images", "points3D")
RESIZED_FOLDERS = (2, 4, 8)  # images_2, images_4, images_8: photos that someone has shrunk already
LARGEST_SIDE = 1600  # pixels, of photos that are loaded without being told a size (as INRIA's)


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

    photos, already = photo_folder(path, downscale)
    found = masks.masks_of(path, [image.name for image in registered])
    sources = [source_of(image, model, photos, found.get(image.name)) for image in registered]
    factor = shrink_factor(sources, already, downscale)
    views = [source.view(factor) for source in sources]
    train, test = hold_out(views)
    points = point_cloud(model)

    present = sum(images.is_image(p) for p in photos.rglob("*"))
    notes.append(f"{len(views)} of {present} photos registered, {len(test)} held out for testing")
    notes.append(f"{len(points):,} points; photos {sizes_of(views)} from {photos.name}/{scaling(factor)}")
    if found:
        notes.append(f"masks for {len(found)} of {len(views)} photos, from {masks.FOLDER}/")
    errors = reprojection_errors(model, registered, {view.name: view.camera for view in views})
    if len(errors):
        notes.append(f"median reprojection error {np.median(errors):.2f} px ({len(errors):,} observations)")
    return Dataset(train, test, points, tuple(notes))


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


def photo_folder(path: Path, downscale: int | None) -> tuple[Path, int]:
    """The folder of photos, and by how much those in it are shrunk already."""
    if downscale in RESIZED_FOLDERS and (path / f"images_{downscale}").is_dir():
        return path / f"images_{downscale}", downscale
    for factor in (1, *RESIZED_FOLDERS):
        folder = path / ("images" if factor == 1 else f"images_{factor}")
        if folder.is_dir() and (downscale is None or factor <= downscale):
            return folder, factor
    raise DatasetError(
        f"{path}: no folder of photos. Put them in {path / 'images'}, under the names COLMAP saw."
    )


@dataclass(frozen=True)
class Source:
    """A registered photo on disk."""

    name: str
    path: Path
    mask: Path | None
    upright: bool  # its EXIF orientation must be applied to match its camera
    camera: pycolmap.Camera  # of the photo's real size
    cam_from_world: np.ndarray

    def view(self, factor: float) -> View:
        """The view at 1 / factor of the photo's size, without distortion."""
        pinhole, straighten = undistortion(self.camera)
        camera = camera_of(pinhole, self.cam_from_world)
        width, height = (max(1, round(side / factor)) for side in (camera.width, camera.height))
        decode = partial(decode_photo, self.path, self.upright, straighten, width, height)
        mask = None
        if self.mask:
            on_disk = (self.camera.width, self.camera.height)
            mask = masks.decoder(self.mask, on_disk, straighten, (width, height))
        return View(self.name, camera.resized(width, height), decode, mask)


def camera_of(pinhole: pycolmap.Camera, cam_from_world: Float[np.ndarray, "3 4"]) -> Camera:
    """Our camera, from COLMAP's intrinsics of a pinhole and a pose."""
    return Camera(
        fx=jnp.float32(pinhole.focal_length_x),
        fy=jnp.float32(pinhole.focal_length_y),
        cx=jnp.float32(pinhole.principal_point_x),
        cy=jnp.float32(pinhole.principal_point_y),
        cam_from_world=jnp.asarray(np.vstack([cam_from_world, [0, 0, 0, 1]]), jnp.float32),
        width=pinhole.width,
        height=pinhole.height,
    )


def decode_photo(
    path: Path, upright: bool, straighten: Callable[[Pixels], Pixels], width: int, height: int
) -> Pixels:
    return images.resize(straighten(images.read(path, upright=upright)), width, height)


def source_of(
    image: pycolmap.Image, model: pycolmap.Reconstruction, photos: Path, mask: Path | None
) -> Source:
    """Finds the photo of a registered image, and fits its camera to the photo's real size."""
    path = find_photo(photos, image.name)
    camera = pycolmap.Camera(model.camera(image.camera_id).todict())
    for upright in (False, True):
        width, height = images.size_of(path, upright=upright)
        # Equal proportions, give or take the rounding of a resize.
        if abs(width * camera.height / camera.width - height) <= 1.5:
            camera.rescale(width, height)
            return Source(image.name, path, mask, upright, camera, image.cam_from_world().matrix())
    width, height = images.size_of(path)
    raise DatasetError(
        f"{path}: {width} x {height} pixels, but its camera is {camera.width} x {camera.height}: other "
        "proportions, so it is not the photo that COLMAP saw. Put that one back, uncropped."
    )


def find_photo(photos: Path, name: str) -> Path:
    """The photo of this name, or of the same name with another suffix (as resized copies have)."""
    if (photos / name).is_file():
        return photos / name
    same_stem = sorted(p for p in (photos / name).parent.glob("*") if p.stem == Path(name).stem)
    if same_stem := [p for p in same_stem if images.is_image(p)]:
        return same_stem[0]
    raise DatasetError(
        f"{photos / name}: the photo is missing, but the COLMAP model has it registered. Put it back, "
        "or remove it from the model (colmap image_deleter)."
    )


def shrink_factor(sources: list[Source], already: int, downscale: int | None) -> float:
    """By how much photos are to be shrunk, beyond what those on disk are."""
    if downscale is not None:
        return downscale / already
    longest = max(max(source.camera.width, source.camera.height) for source in sources)
    return float(-(-longest // LARGEST_SIDE))


def undistortion(camera: pycolmap.Camera) -> tuple[pycolmap.Camera, Callable[[Pixels], Pixels]]:
    """A pinhole for the photos of a camera, and what brings its photos into that form."""
    # pycolmap calls all that is no fisheye a "perspective pinhole", whatever its distortion.
    if camera.is_perspective_pinhole() and camera.is_undistorted():
        return camera, lambda pixels: pixels
    options = pycolmap.UndistortCameraOptions()

    def straighten(pixels: Pixels) -> Pixels:
        parts = [pixels[..., :3], *([pixels[..., 3]] if pixels.shape[2] == 4 else [])]
        bitmaps = [pycolmap.Bitmap.from_array(np.ascontiguousarray(part)) for part in parts]
        straight = [pycolmap.undistort_image(options, bitmap, camera)[0].to_array() for bitmap in bitmaps]
        return np.dstack(straight)

    return pycolmap.undistort_camera(options, camera), straighten


def point_cloud(model: pycolmap.Reconstruction) -> PointCloud:
    """The model's points."""
    points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in points], np.float32).reshape(-1, 3) / 255
    return PointCloud(positions, colors)


def sizes_of(views: list[View]) -> str:
    """ "504 x 378", or the range of sizes."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    names = [f"{width} x {height}" for width, height in sizes]
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def scaling(factor: float) -> str:
    return "" if factor == 1 else f", shrunk {factor:g} times"
