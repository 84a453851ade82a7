"""Photos with known cameras, which every loader uses: read, undistorted, turned and resized on demand."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera, from_colmap
from splatax.cameras.conventions import COLMAP_MODELS, PANORAMA
from splatax.cameras.lenses import Orthographic
from splatax.dataset import Survey, View
from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import masks, names
from splatax.io.datasets.decoding import MaskDecoder, PhotoDecoder, Stored
from splatax.io.datasets.undistortion import Straightening, is_pinhole, undistortion

if TYPE_CHECKING:
    import pycolmap

RESIZED_FOLDERS = (2, 4, 8)  # images_2, images_4, images_8: photos that another tool has shrunk
LARGEST_SIDE = 1600  # pixels, of photos loaded without `downscale` (as in INRIA's code)
LARGEST_CAMERA = 1 << 20  # pixels of a side, more than any photo has
KNOWN = {*COLMAP_MODELS, PANORAMA}  # lenses that need not be undistorted
NAMED = 3  # photos that a message names; the rest are counted


def photo_folder(path: Path, downscale: int | None) -> tuple[Path, int]:
    """Returns the folder of photos, and the factor by which its photos have been shrunk."""
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
    """A registered photo on disk.

    Attributes:
        name: name of the photo, unique in the capture.
        path: path of the photo.
        mask: path of its mask, if it has one.
        upright: True if its EXIF orientation must be applied to match its camera.
        divisor: factor by which decoding shrinks the photo to fit into memory.
        camera: camera at the decoded size.
        cam_from_world: pose, with x right, y down, z forward.
        parallel: true for an orthophoto, whose focal lengths are pixels for a world unit.
    """

    name: str
    path: Path
    mask: Path | None
    upright: bool
    divisor: int
    camera: "pycolmap.Camera"
    cam_from_world: Float[np.ndarray, "3 4"]
    parallel: bool = False

    @property
    def known(self) -> bool:
        """True if splatax has the lens of the photo, so that it need not be undistorted."""
        return self.camera.model.name in KNOWN

    def view(self, factor: float, undistort: bool) -> View:
        """Returns the view at 1 / factor of the stored photo's size, but no larger than the decoded photo.

        Args:
            factor: at least 1.
            undistort: resamples the photo for a pinhole camera. The photo of a lens that splatax does not
                know is always resampled.
        """
        factor = max(factor / self.divisor, 1.0)
        with blamed_on(self.path, "its camera cannot be used", "Calibrate it again.", DatasetError):
            if undistort and (self.parallel or self.camera.model.name == PANORAMA):
                raise DatasetError(
                    f"{self.path}: an orthophoto or a panorama cannot be undistorted. Use it as it is."
                )
            if undistort or not self.known:
                pinhole, straighten = undistortion(self.camera, factor)
                camera = camera_of(pinhole, self.cam_from_world)
            else:
                straighten, camera = Straightening(), self.camera_as_it_is()
        width, height = (max(1, round(side / factor)) for side in (camera.width, camera.height))
        decoded = self.camera.width, self.camera.height
        stored = Stored(self.path, decoded, straighten, (width, height))
        mask = MaskDecoder(replace(stored, path=self.mask)) if self.mask else None
        if self.mask:
            masks.check_proportions(self.mask, decoded)
        pixels = PhotoDecoder(stored, self.upright, self.divisor)
        return View(self.name, camera.resized(width, height), pixels, mask)

    def camera_as_it_is(self) -> Camera:
        """Returns the camera of the decoded photo, with its lens."""
        camera = camera_of(self.camera, self.cam_from_world)
        return replace(camera, lens=Orthographic()) if self.parallel else camera


def source_of(
    name: str,
    path: Path,
    camera: "pycolmap.Camera",
    cam_from_world: Float[np.ndarray, "3 4"],
    capture: Path,
    mask: Path | None = None,
    parallel: bool = False,
) -> Source:
    """Returns the source of a photo, with its camera scaled to the photo's actual size.

    Args:
        name: name of the photo, unique in the capture.
        path: path of the photo, below the folder of the capture.
        camera: camera as it was calibrated, perhaps for another size.
        cam_from_world: pose.
        capture: folder in which photo and mask must lie after all links are followed.
        mask: path of its mask, if it has one.
        parallel: true for an orthophoto.

    Raises:
        DatasetError: if the proportions of the photo and the camera differ, upright or not, a number of the
            camera or the pose is not finite, or a link leads out of the capture.
    """
    import pycolmap

    for file in (path, *([mask] if mask else [])):
        names.confined(file, capture)
    check_camera(path, camera, cam_from_world)
    camera = pycolmap.Camera(camera.todict())
    for upright in (False, True):
        header = images.header_of(path, upright=upright)
        width, height = header.size
        # Proportions are equal up to the rounding of a resize.
        if abs(width * camera.height / camera.width - height) <= 1.5:
            camera.rescale(width, height)
            return Source(name, path, mask, upright, header.divisor, camera, cam_from_world, parallel)
    width, height = images.size_of(path)
    raise DatasetError(
        f"{path}: {width} x {height} pixels, but its camera is {camera.width} x {camera.height}: other "
        "proportions, so it is not the photo that the poses were found from. Put that one back, uncropped."
    )


def check_camera(path: Path, camera: "pycolmap.Camera", cam_from_world: Float[np.ndarray, "3 4"]) -> None:
    """Refuses a camera or a pose that no photo can have.

    Raises:
        DatasetError: if the camera has no pixels or no positive focal length, or a number is not finite.
    """
    with np.errstate(over="ignore", under="ignore"):  # cameras are used in float32
        focal = focal_lengths(camera)
        lens = np.array([*focal, *camera.params], np.float32)
        pose = cam_from_world.astype(np.float32)
    sized = all(0 < side <= LARGEST_CAMERA for side in (camera.width, camera.height))
    if not (sized and np.isfinite(lens).all() and lens[: len(focal)].min() > 0):
        values = " ".join(f"{value:.6g}" for value in camera.params)
        raise DatasetError(
            f"{path}: its camera is {camera.width} x {camera.height} pixels with the parameters "
            f"{shown(values)}, which no photo has. Calibrate it again, or correct the file of cameras."
        )
    if not np.isfinite(pose).all():
        raise DatasetError(
            f"{path}: its pose has numbers that are not finite. Find the poses again, or remove the photo."
        )


def focal_lengths(camera: "pycolmap.Camera") -> tuple[float, ...]:
    """Returns the focal lengths of a camera, pixels; its size for a panorama, which has none."""
    if camera.model.name == PANORAMA:
        return float(camera.width), float(camera.height)
    return camera.focal_length_x, camera.focal_length_y


def camera_of(calibrated: "pycolmap.Camera", cam_from_world: Float[np.ndarray, "3 4"]) -> Camera:
    """Returns a `Camera` from COLMAP's intrinsics and a pose."""
    pose = jnp.asarray(np.vstack([cam_from_world, [0, 0, 0, 1]]), jnp.float32)
    model, parameters = calibrated.model.name, calibrated.params.tolist()
    if is_pinhole(calibrated):  # some readers write zeros for the distortion
        model, parameters = (
            "PINHOLE",
            [*focal_lengths(calibrated), calibrated.principal_point_x, calibrated.principal_point_y],
        )
    return from_colmap(model, parameters, calibrated.width, calibrated.height, pose)


def shrink_factor(sources: list[Source], already: int, downscale: int | None) -> float:
    """Returns the factor by which to shrink photos, relative to the photos on disk."""
    if downscale is not None:
        return downscale / already
    longest = max(source.divisor * max(source.camera.width, source.camera.height) for source in sources)
    return float(-(-longest // LARGEST_SIDE))


def unused(folder: Path, used: Iterable[Path]) -> tuple[str, ...]:
    """Returns the names of the photos in a folder that no view uses."""
    photos = {path for path in folder.rglob("*") if images.is_image(path)}
    return tuple(sorted(shown(path.relative_to(folder).as_posix()) for path in photos.difference(used)))


def survey(
    sources: list[Source], unused: tuple[str, ...], errors: dict[str, Float[np.ndarray, " _"]]
) -> Survey:
    """Returns the survey of the photos on disk."""
    files = {source.name: source.path for source in sources}
    return Survey(files, {source.name: lens(source.camera) for source in sources}, unused, errors)


def lens(camera: "pycolmap.Camera") -> str:
    """Describes a camera in words: "SIMPLE_RADIAL 504 x 378, f=407.57 cx=252 cy=189 k=0.01975"."""
    names = [name.strip() for name in camera.params_info.split(",")]
    values = " ".join(f"{name}={value:.6g}" for name, value in zip(names, camera.params, strict=True))
    return f"{camera.model.name} {camera.width} x {camera.height}, {values}"


def sizes_of(views: list[View]) -> str:
    """Returns the common size of views in words, such as "504 x 378", or the range of their sizes."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    names = [f"{width} x {height}" for width, height in sizes]
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def limited(sources: list[Source]) -> list[str]:
    """Returns a list with a note about photos that are decoded smaller than stored, or an empty list."""
    smaller = [source.name for source in sources if source.divisor > 1]
    if not smaller:
        return []
    limit = images.memory_limit() / 1e9
    return [
        f"{counted(len(smaller))} decoded at half the size or less, to take no more than {limit:.1f} GB of "
        f"memory each: {listed(smaller)}"
    ]


def scaling(factor: float) -> str:
    """Returns the factor of shrinking as the end of a sentence; an empty string if it is 1."""
    return "" if factor == 1 else f", shrunk {factor:g} times"


def counted(number: int, thing: str = "photo") -> str:
    """Returns a number of photos, or of other things, in words: "1 photo", "2 photos"."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def listed(found: Iterable[str]) -> str:
    """Returns names as part of a sentence, of which it lists the first few: "a, b, c and 4 more"."""
    every = [shown(name) for name in found]
    more = f" and {len(every) - NAMED} more" if len(every) > NAMED else ""
    return ", ".join(every[:NAMED]) + more
