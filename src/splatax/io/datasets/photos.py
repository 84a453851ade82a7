"""Photos with known cameras, as every loader has them: sized, undistorted and turned on demand."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pycolmap
from jaxtyping import Float

from splatax.camera import Camera
from splatax.dataset import Pixels, Survey, View
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.datasets import masks
from splatax.io.datasets.undistortion import undistortion
from splatax.resampling import resize

RESIZED_FOLDERS = (2, 4, 8)  # images_2, images_4, images_8: photos that someone has shrunk already
LARGEST_SIDE = 1600  # pixels, of photos that are loaded without being told a size (as INRIA's)
NAMED = 3  # photos that a message names before it counts the rest


def photo_folder(path: Path, downscale: int | None) -> tuple[Path, int]:
    """The folder of photos, and by how much those in it are shrunk already."""
    if downscale in RESIZED_FOLDERS and (path / f"images_{downscale}").is_dir():
        return path / f"images_{downscale}", downscale
    for factor in (1, *RESIZED_FOLDERS):
        folder = path / ("images" if factor == 1 else f"images_{factor}")
        if folder.is_dir() and (downscale is None or factor <= downscale):
            return folder, factor
    raise DatasetError(
        f"{path}: no folder of photos. Put them in {path / 'images'}, under the names that its poses have."
    )


@dataclass(frozen=True)
class Source:
    """A registered photo on disk."""

    name: str
    path: Path
    mask: Path | None
    upright: bool  # its EXIF orientation must be applied to match its camera
    camera: pycolmap.Camera  # of the photo's real size
    cam_from_world: Float[np.ndarray, "3 4"]

    def view(self, factor: float) -> View:
        """The view at 1 / factor of the photo's size, without distortion."""
        pinhole, straighten = undistortion(self.camera, factor)
        camera = camera_of(pinhole, self.cam_from_world)
        width, height = (max(1, round(side / factor)) for side in (camera.width, camera.height))
        decode = partial(decode_photo, self.path, self.upright, straighten, width, height)
        mask = None
        if self.mask:
            on_disk = (self.camera.width, self.camera.height)
            mask = masks.decoder(self.mask, on_disk, straighten, (width, height))
        return View(self.name, camera.resized(width, height), decode, mask)


def source_of(
    name: str,
    path: Path,
    camera: pycolmap.Camera,
    cam_from_world: Float[np.ndarray, "3 4"],
    mask: Path | None = None,
) -> Source:
    """Fits the camera of a photo to the photo's real size.

    Raises:
        DatasetError: if the photo has other proportions than its camera, upright or not.
    """
    camera = pycolmap.Camera(camera.todict())
    for upright in (False, True):
        width, height = images.size_of(path, upright=upright)
        # Equal proportions, give or take the rounding of a resize.
        if abs(width * camera.height / camera.width - height) <= 1.5:
            camera.rescale(width, height)
            return Source(name, path, mask, upright, camera, cam_from_world)
    width, height = images.size_of(path)
    raise DatasetError(
        f"{path}: {width} x {height} pixels, but its camera is {camera.width} x {camera.height}: other "
        "proportions, so it is not the photo that the poses were found from. Put that one back, uncropped."
    )


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
    return resize(straighten(images.read(path, upright=upright)), width, height)


def shrink_factor(sources: list[Source], already: int, downscale: int | None) -> float:
    """By how much photos are to be shrunk, beyond what those on disk are."""
    if downscale is not None:
        return downscale / already
    longest = max(max(source.camera.width, source.camera.height) for source in sources)
    return float(-(-longest // LARGEST_SIDE))


def unused(folder: Path, used: Iterable[Path]) -> tuple[str, ...]:
    """Photos in a folder, by name, that no view was made of."""
    photos = {path for path in folder.rglob("*") if images.is_image(path)}
    return tuple(sorted(path.relative_to(folder).as_posix() for path in photos.difference(used)))


def survey(
    sources: list[Source], unused: tuple[str, ...], errors: dict[str, Float[np.ndarray, " _"]]
) -> Survey:
    """What was seen of photos on disk."""
    files = {source.name: source.path for source in sources}
    return Survey(files, {source.name: lens(source.camera) for source in sources}, unused, errors)


def lens(camera: pycolmap.Camera) -> str:
    """A camera in words: "SIMPLE_RADIAL 504 x 378, f=407.57 cx=252 cy=189 k=0.01975"."""
    names = camera.params_info.split(", ")
    values = " ".join(f"{name}={value:.6g}" for name, value in zip(names, camera.params, strict=True))
    return f"{camera.model.name} {camera.width} x {camera.height}, {values}"


def sizes_of(views: list[View]) -> str:
    """ "504 x 378", or the range of sizes."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    names = [f"{width} x {height}" for width, height in sizes]
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def scaling(factor: float) -> str:
    return "" if factor == 1 else f", shrunk {factor:g} times"


def counted(number: int) -> str:
    """ "1 photo", "2 photos"."""
    return f"{number} photo" if number == 1 else f"{number} photos"


def listed(names: Iterable[str]) -> str:
    """ "a, b, c and 4 more"."""
    every = list(names)
    more = f" and {len(every) - NAMED} more" if len(every) > NAMED else ""
    return ", ".join(every[:NAMED]) + more
