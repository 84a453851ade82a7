"""Points from depth maps: pixels with known depth, moved into the world.

They are the initial points of a capture that has no sparse points, and landmarks of their photos.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatax.cameras.geometry import points_at
from splatax.dataset import PointCloud
from splatax.errors import DatasetError
from splatax.io import images
from splatax.io.damage import blamed_on
from splatax.io.datasets import names
from splatax.io.datasets.capture import NO_POINTS, DepthMap, cloud
from splatax.io.datasets.photos import Source, counted

MOST_POINTS = 100_000  # of all depth maps together
MOST_LANDMARKS = 8_192  # of one depth map
MOST_MAPS = 64  # evenly spaced over the capture; photos are decoded for their colours
WAY_OUT = "Export the depth again, or remove it."


def points_of(
    sources: list[Source], maps: Mapping[str, DepthMap], capture: Path
) -> tuple[PointCloud, tuple[str, ...]]:
    """Returns points of the depth maps, with the colours of their photos, and a note if there are any.

    Args:
        sources: photos of the capture.
        maps: depth maps by the names of the photos; may be empty. Missing files are left out.
        capture: folder in which the files must lie.

    Raises:
        DatasetError: if a depth map is damaged, or its proportions are not those of its photo.
    """
    known = [source for source in sources if source.name in maps and maps[source.name].path.is_file()]
    if not known:
        return NO_POINTS, ()
    chosen = known[:: -(-len(known) // MOST_MAPS)]
    clouds = [points_in(source, maps[source.name], MOST_POINTS // len(chosen), capture) for source in chosen]
    positions, colors = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
    if not len(positions):
        return NO_POINTS, (f"the depth maps of {counted(len(chosen))} have no known depth",)
    points = cloud(maps[chosen[0].name].path, positions, colors)
    return points, (f"the points are from the depth maps of {counted(len(chosen))}",)


def points_in(
    source: Source, depth: DepthMap, most: int, capture: Path
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns positions and colours of an evenly spaced sample of a photo's pixels with known depth."""
    positions, where = measured(source, depth, most, capture)
    pixels = images.read(source.path, upright=source.upright, divisor=source.divisor)
    colors = pixels[where[:, 1].astype(int), where[:, 0].astype(int), :3].astype(np.float64) / 255
    return positions, colors


def landmarks_in(source: Source, depth: DepthMap, capture: Path) -> Float[np.ndarray, "n 3"]:
    """Returns the positions of an evenly spaced sample of a photo's pixels with known depth.

    Raises:
        DatasetError: if the depth map is damaged, or its proportions are not those of its photo.
    """
    return measured(source, depth, MOST_LANDMARKS, capture)[0].astype(np.float32)


def measured(
    source: Source, depth: DepthMap, most: int, capture: Path
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Returns positions and pixels of an evenly spaced sample of a photo's pixels with known depth."""
    distances = read(depth, capture)
    height, width = distances.shape
    camera = source.camera
    if abs(width * camera.height / camera.width - height) > 1.5:
        raise DatasetError(
            f"{depth.path}: {width} x {height} pixels, but its photo has {camera.width} x {camera.height}: "
            f"other proportions. {WAY_OUT}"
        )
    rows, columns = np.nonzero(distances > 0)
    step = max(1, -(-len(rows) // max(most, 1)))
    rows, columns = rows[::step], columns[::step]
    # COLMAP's origin is the photo's corner, so pixel centres are at halves.
    where = np.stack([(columns + 0.5) * camera.width / width, (rows + 0.5) * camera.height / height], axis=1)
    return points_at(source.camera_as_it_is(), where, distances[rows, columns]), where


def read(depth: DepthMap, capture: Path) -> Float[np.ndarray, "h w"]:
    """Reads a depth map in world units; zero where the depth is unknown.

    Raises:
        DatasetError: if the file is damaged, or is not a picture of depth.
    """
    path = names.confined(depth.path, capture)
    with blamed_on(path, "not a depth map that can be read", WAY_OUT, DatasetError):
        if path.suffix.lower() == ".npy":
            # Memory-mapped, because the header may claim any size.
            values = np.load(path, mmap_mode="r", allow_pickle=False)
            values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
        else:
            values = levels(path)
    if values.ndim != 2 or values.dtype.kind not in "fui" or not values.size:
        raise DatasetError(
            f"{path}: not a depth map, but {values.dtype} numbers of shape {values.shape}. {WAY_OUT}"
        )
    if depth.confidence and depth.confidence.is_file():
        trusted = levels(names.confined(depth.confidence, capture))
        if trusted.shape != values.shape:
            raise DatasetError(f"{depth.confidence}: another size than {path.name}. {WAY_OUT}")
        values = np.where(trusted > 0, values, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.asarray(values, np.float64) * depth.unit
        return np.where(np.isfinite(distances) & (distances > 0), distances, 0)


def levels(path: Path) -> np.ndarray:
    """Returns the numbers of a picture of one channel, as they are stored.

    Raises:
        DatasetError: if the file is not a picture, is damaged, or would not fit into memory.
    """
    images.header_of(path)  # checks that it fits into memory
    with images.opened(path, "depth map", WAY_OUT) as image:
        return np.array(image)
