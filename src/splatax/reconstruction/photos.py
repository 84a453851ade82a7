"""Finds the photos to reconstruct from, reads them upright, and reads their lens and device from EXIF."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatax.dataset import Pixels
from splatax.errors import DatasetError, InputError, shown
from splatax.io import images
from splatax.io.datasets import names
from splatax.io.video import is_video
from splatax.reconstruction.panoramas import Panoramas, looks_like_one, says_so

COMMON = {".jpg", ".jpeg", ".png"}  # suffixes of formats that all tools read
HEIF = {".heic", ".heif"}
OTHER = {".gif", ".avif", ".jxl", ".jp2", ".psd"}  # photos in formats that are not read
RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"}  # nor these
LOSSLESS = {".png", ".bmp", ".tif", ".tiff"}
UNREADABLE = "cannot be read: not a format that splatax knows. Save it as JPEG or PNG"
VIDEO = "a video, and those among photos are not read. Give the video itself, or save its frames as photos"
HEIF_PACKAGE = (
    "reading HEIC needs another package. Install it: pip install '.[heic]' in the checkout of splatax, or "
    "export JPEG"
)
DIAGONAL_35MM = float(np.hypot(36, 24))  # mm; the 35 mm equivalent refers to the diagonal (CIPA DCG-001)
MM_PER_UNIT = {2: 25.4, 3: 10.0}  # EXIF's FocalPlaneResolutionUnit: inch, centimetre
MAKE, MODEL, EXIF = 0x010F, 0x0110, 0x8769
ORIENTATION = 0x0112
FOCAL, FOCAL_35MM, LENS = 0x920A, 0xA405, 0xA434
PLANE_RESOLUTION, PLANE_UNIT, EXIF_WIDTH, EXIF_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003


@dataclass(frozen=True)
class Photo:
    """Photo on disk.

    Attributes:
        name: unique name in the capture: its path in the folder, with a suffix that all tools read.
        path: path of the file.
        size: width and height when upright, pixels.
        focal: focal length from EXIF, pixels; None if EXIF has none.
        device: camera and lens in EXIF. Photos of one device and size share a camera.
        upright: true if the file itself is upright, so that its EXIF orientation turns nothing.
        panorama: true for a 360-degree photo.
        wide: true if it may be one: it is twice as wide as it is high, but its metadata do not say so.
    """

    name: str
    path: Path
    size: tuple[int, int]
    focal: float | None
    device: str
    upright: bool = True
    panorama: bool = False
    wide: bool = False


def photos_in(folder: Path, panoramas: Panoramas = "auto") -> tuple[list[Photo], dict[str, str]]:
    """Returns the photos in a folder sorted by name, and the reasons why others cannot be used, by name.

    Args:
        folder: folder of the photos.
        panoramas: which of the photos that are twice as wide as high show 360 degrees: those whose metadata
            say so, all, or none.

    Raises:
        InputError: if there is a HEIC photo, and the package that reads it is not installed.
    """
    paths, unused = files_of(folder)
    if heif := [path for path in paths if is_heif(path)]:
        learn_heif(heif[0])
    photos: list[Photo] = []
    damaged = {shown(path.relative_to(folder).as_posix()): reason for path, reason in unused.items()}
    present = {path.relative_to(folder).as_posix() for path in paths}
    for path in paths:
        name = path.relative_to(folder).as_posix()
        try:
            saved = name_in_capture(names.checked(name, folder))
            if saved != name and saved in present:
                raise DatasetError(
                    f"it would be saved as {shown(saved)}, as another photo. Rename one of them"
                )
            photos.append(photo_of(saved, path, panoramas))
        except DatasetError as error:
            damaged[shown(name)] = f"cannot be read: {error}"
    return photos, damaged


def files_of(folder: Path) -> tuple[list[Path], dict[Path, str]]:
    """Returns the photos in a folder, and the reasons why its videos and other photos are not used.

    A file beside a photo of the same name is not listed: the raw file of a camera, or the video of a live
    photo.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    photos = [path for path in files if is_photo(path)]
    known = {path.with_suffix("") for path in photos}
    unused = {path: UNREADABLE for path in files if path.suffix.lower() in OTHER | RAW}
    unused |= {path: VIDEO for path in files if is_video(path)}
    return photos, {path: why for path, why in unused.items() if path.with_suffix("") not in known}


def is_photo(path: Path) -> bool:
    """Returns whether a path has the suffix of a photo, HEIC included."""
    return images.is_image(path) or is_heif(path)


def is_heif(path: Path) -> bool:
    """Returns whether a path has the suffix of a HEIC photo and is not hidden."""
    return path.suffix.lower() in HEIF and not path.name.startswith(".")


def learn_heif(example: Path) -> None:
    """Registers Pillow's plugin for HEIC.

    Raises:
        InputError: if the package is not installed.
    """
    try:
        import pillow_heif
    except ImportError:
        raise InputError(f"{example}: {HEIF_PACKAGE}.") from None
    pillow_heif.register_heif_opener()


def name_in_capture(name: str) -> str:
    """Returns the name of the photo in the capture."""
    suffix = Path(name).suffix.lower()
    if suffix in COMMON:
        return name
    return name + (".png" if suffix in LOSSLESS else ".jpg")


def photo_of(name: str, path: Path, panoramas: Panoramas = "auto") -> Photo:
    """Reads the header of a photo.

    Args:
        name: of the photo in the capture.
        path: path of the file.
        panoramas: as for `photos_in`.

    Raises:
        DatasetError: if the file is not a photo, or is damaged.
    """
    size = images.size_of(path, upright=True)
    with images.opened(path) as image:
        exif = image.getexif()  # a PNG may store it behind the pixels
        detail = exif.get_ifd(EXIF)
        upright = exif.get(ORIENTATION, 1) == 1
        known = says_so(image)
    focal = focal_of({key: number(value) for key, value in detail.items()}, size)
    parts = (exif.get(MAKE), exif.get(MODEL), detail.get(LENS), focal, size)
    device = " ".join(str(part) for part in parts)
    wide = looks_like_one(size)
    panorama = wide and (panoramas == "all" or (panoramas == "auto" and known))
    unsaid = wide and panoramas == "auto" and not known
    return Photo(name, path, size, focal, device, upright, panorama, unsaid)


def number(value: object) -> float:
    """Returns an EXIF value as a number, or 0 if it is not a positive one."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return found if np.isfinite(found) and found > 0 else 0.0


def focal_of(exif: dict[int, float], size: tuple[int, int]) -> float | None:
    """Returns the focal length in pixels, from its 35 mm equivalent or the sensor's pixel pitch."""
    if equivalent := exif.get(FOCAL_35MM, 0.0):
        return equivalent * float(np.hypot(*size)) / DIAGONAL_35MM
    unit = MM_PER_UNIT.get(int(exif.get(PLANE_UNIT, 2.0)), 0.0)
    pixels, sensor_pixels = max(size), max(exif.get(EXIF_WIDTH, 0.0), exif.get(EXIF_HEIGHT, 0.0))
    density, millimetres = exif.get(PLANE_RESOLUTION, 0.0), exif.get(FOCAL, 0.0)
    if unit and density and millimetres and sensor_pixels:
        return millimetres * density / unit * pixels / sensor_pixels
    return None


def read(photo: Photo) -> Pixels:
    """Decodes a photo and turns it upright.

    Raises:
        DatasetError: if the photo is damaged.
    """
    return images.read(photo.path, upright=True)


def copy(photo: Photo, path: Path) -> None:
    """Copies a photo as it is; one that is not upright, or in a rare format, is decoded and saved again.

    Raises:
        DatasetError: if the photo is damaged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if photo.upright and photo.path.suffix.lower() in COMMON:
        shutil.copyfile(photo.path, path)
    else:
        save(path, read(photo))


def save(path: Path, pixels: Pixels) -> None:
    """Writes a PNG, or a JPEG that is visually lossless."""
    path.parent.mkdir(parents=True, exist_ok=True)
    from PIL import Image

    image = Image.fromarray(pixels)
    if path.suffix.lower() == ".png":
        image.save(path)
    else:
        image.convert("RGB").save(path, "JPEG", quality=95, subsampling=0)
