"""Finds the photos to reconstruct from, reads them upright, and reads from EXIF what took them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatax.dataset import Pixels
from splatax.errors import DatasetError, InputError, shown
from splatax.io import images
from splatax.io.datasets import names

HEIF = {".heic", ".heif"}
LOSSLESS = {".png", ".bmp", ".tif", ".tiff"}
DIAGONAL_35MM = float(np.hypot(36, 24))  # mm; "35 mm equivalent" is by the diagonal (CIPA DCG-001)
MM_PER_UNIT = {2: 25.4, 3: 10.0}  # of EXIF's FocalPlaneResolutionUnit: inch, centimetre
MAKE, MODEL, EXIF = 0x010F, 0x0110, 0x8769
FOCAL, FOCAL_35MM, LENS = 0x920A, 0xA405, 0xA434
PLANE_RESOLUTION, PLANE_UNIT, EXIF_WIDTH, EXIF_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003


@dataclass(frozen=True)
class Photo:
    """One photo on disk.

    Attributes:
        name: in the capture, unique: its path in the folder, with a suffix that all tools read.
        path: where it lies.
        size: upright, pixels.
        focal: from EXIF, pixels; None if that does not tell.
        device: what took it, so that photos of one device and size share a camera.
    """

    name: str
    path: Path
    size: tuple[int, int]
    focal: float | None
    device: str


def photos_in(folder: Path) -> tuple[list[Photo], dict[str, str]]:
    """Returns the photos in a folder by name, and why others cannot be used, by name.

    Raises:
        InputError: if there is a HEIC photo, and nothing to read it with.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and is_photo(path))
    if any(path.suffix.lower() in HEIF for path in paths):
        learn_heif(next(path for path in paths if path.suffix.lower() in HEIF))
    photos, damaged = [], {}
    for path in paths:
        name = path.relative_to(folder).as_posix()
        try:
            photos.append(photo_of(name_in_capture(names.checked(name, folder)), path))
        except DatasetError as error:
            damaged[shown(name)] = f"cannot be read: {error}"
    return photos, damaged


def is_photo(path: Path) -> bool:
    """Returns whether the name is that of a photo, HEIC included."""
    return images.is_image(path) or (path.suffix.lower() in HEIF and not path.name.startswith("."))


def learn_heif(example: Path) -> None:
    """Lets Pillow read HEIC.

    Raises:
        InputError: if the package for that is not installed.
    """
    try:
        import pillow_heif
    except ImportError:
        raise InputError(
            f"{example}: reading HEIC needs another package: pip install 'splatax[heic]'. Or export JPEG."
        ) from None
    pillow_heif.register_heif_opener()


def name_in_capture(name: str) -> str:
    """Returns the name under which the undistorted photo is saved."""
    suffix = Path(name).suffix.lower()
    if suffix in {".jpg", ".jpeg", ".png"}:
        return name
    return name + (".png" if suffix in LOSSLESS else ".jpg")


def photo_of(name: str, path: Path) -> Photo:
    """Measures a photo by its header.

    Raises:
        DatasetError: if it is not a photo, or damaged.
    """
    size = images.size_of(path, upright=True)
    with images.opened(path) as image:
        exif = image.getexif()  # of a PNG it may be behind the pixels
        detail = exif.get_ifd(EXIF)
    focal = focal_of({key: number(value) for key, value in detail.items()}, size)
    parts = (exif.get(MAKE), exif.get(MODEL), detail.get(LENS), focal, size)
    return Photo(name, path, size, focal, " ".join(str(part) for part in parts))


def number(value: object) -> float:
    """Returns an EXIF value, or 0 where it is not a positive number."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return found if np.isfinite(found) and found > 0 else 0.0


def focal_of(exif: dict[int, float], size: tuple[int, int]) -> float | None:
    """Returns the focal length in pixels, from its 35 mm equivalent or the pitch of the sensor's pixels."""
    if equivalent := exif.get(FOCAL_35MM, 0.0):
        return equivalent * float(np.hypot(*size)) / DIAGONAL_35MM
    unit = MM_PER_UNIT.get(int(exif.get(PLANE_UNIT, 2.0)), 0.0)
    pixels, sensor_pixels = max(size), max(exif.get(EXIF_WIDTH, 0.0), exif.get(EXIF_HEIGHT, 0.0))
    density, millimetres = exif.get(PLANE_RESOLUTION, 0.0), exif.get(FOCAL, 0.0)
    if unit and density and millimetres and sensor_pixels:
        return millimetres * density / unit * pixels / sensor_pixels
    return None


def read(photo: Photo) -> Pixels:
    """Decodes a photo, upright.

    Raises:
        DatasetError: if it is damaged.
    """
    return images.read(photo.path, upright=True)


def save(path: Path, pixels: Pixels) -> None:
    """Writes a PNG, or a JPEG that looks the same as the original."""
    path.parent.mkdir(parents=True, exist_ok=True)
    from PIL import Image

    image = Image.fromarray(pixels)
    if path.suffix.lower() == ".png":
        image.save(path)
    else:
        image.convert("RGB").save(path, "JPEG", quality=95, subsampling=0)
