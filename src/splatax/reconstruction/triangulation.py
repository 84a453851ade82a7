"""Triangulates points from photos whose cameras are known, for captures that come without points."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatax.cameras import Camera
from splatax.dataset import Pixels, PointCloud, View, mask_of
from splatax.io.datasets.colmap_writing import colmap_camera, model_of_cameras
from splatax.packages import required_by
from splatax.reconstruction import mapping
from splatax.reconstruction.calibration import known_to_colmap
from splatax.reconstruction.mapping import Features
from splatax.reconstruction.pairs import Exhaustive, Pairing, Similar
from splatax.reconstruction.photos import save
from splatax.reconstruction.pipeline import FEW, Watch, features_for

if TYPE_CHECKING:
    import pycolmap

STAGES = ("reading", "features", "matches", "points")
DATABASE = "database.db"  # of features and matches, in the temporary folder
FEWEST_VIEWS = 2
SMALL = 800  # pixels of the longer side, up to which smaller features take little time
VERY_FEW_VIEWS = 30  # up to which points that only two views see are kept


@required_by("splatax.reconstruction")
def triangulated(
    views: Sequence[View], *, seed: int = 0, watch: Watch = lambda stage, done, total: None
) -> PointCloud:
    """Returns points that several views see, from matched features and the given cameras.

    The cameras stay as they are. Pixels outside of masks, and transparent ones, have no features. Works in
    the system's temporary folder.

    Args:
        views: views with cameras that are accurate to a few pixels.
        seed: random seed.
        watch: function that is called with the progress of each of `STAGES`.

    Returns:
        The points; an empty cloud if there are fewer than two views, nothing in them matches, or COLMAP has
        no such lens (orthophotos).
    """
    import pycolmap

    if not matchable(views):
        return PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    with matched(views, seed, watch) as (model, work):
        watch("points", 0, 1)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = seed
        options.triangulation.random_seed = seed
        options.triangulation.ignore_two_view_tracks = len(views) > VERY_FEW_VIEWS
        found = pycolmap.triangulate_points(
            model, work / DATABASE, work / "photos", work / "model", options=options
        )
        watch("points", 1, 1)
    points = list(found.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in points], np.float32).reshape(-1, 3) / 255
    finite = np.isfinite(positions).all(axis=1)
    return PointCloud(positions[finite], colors[finite])


def matchable(views: Sequence[View]) -> bool:
    """Returns whether there are enough views, all with lenses that COLMAP has, for `matched`."""
    return len(views) >= FEWEST_VIEWS and all(known_to_colmap(view.camera) for view in views)


@contextmanager
def matched(
    views: Sequence[View],
    seed: int,
    watch: Watch,
    calibrated: "Callable[[Camera], pycolmap.Camera]" = colmap_camera,
) -> "Iterator[tuple[pycolmap.Reconstruction, Path]]":
    """Matches features of the views, in a temporary folder that is removed at the end.

    Args:
        views: for which `matchable` holds.
        seed: random seed.
        watch: function that is called with the progress of each stage.
        calibrated: function that returns COLMAP's camera for one of the views.

    Yields:
        A model of the given cameras without points, whose images are numbered from 1 in the order of the
        views; and the folder. It has the photos in "photos", the database `DATABASE`, and an empty folder
        "model".
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with tempfile.TemporaryDirectory(prefix="splatax-") as folder:
        work = Path(folder)
        names = [f"{number:06}.png" for number in range(len(views))]
        masks = write_photos(views, names, work, partial(watch, "reading"))
        model = model_of_cameras(zip(names, (view.camera for view in views), strict=True), calibrated)
        database = work / DATABASE
        with mapping.opened(database) as empty:
            register(empty, model)
        mapping.extract(database, work / "photos", features_of(views), partial(watch, "features"), masks)
        pairing: Pairing = Exhaustive() if len(views) <= FEW else Similar()
        mapping.match(database, pairing, seed, partial(watch, "matches"))
        (work / "model").mkdir()
        yield model, work


def write_photos(
    views: Sequence[View], names: Sequence[str], work: Path, watch: Callable[[int, int], None]
) -> Path | None:
    """Writes photos and masks as COLMAP reads them, to WORK/photos and WORK/masks.

    Returns:
        The folder of masks, with one for each photo; None if all pixels of all photos count.
    """
    folder, everything = work / "masks", True
    for number, (name, view) in enumerate(zip(names, views, strict=True)):
        watch(number, len(views))
        pixels, mask = view.pixels(), mask_of(view)
        counts = np.ones(pixels.shape[:2], bool) if mask is None else mask
        if pixels.shape[2] == 4:
            counts = counts & (pixels[..., 3] > 0)
        everything = everything and bool(counts.all())
        save(work / "photos" / name, over_black(pixels))
        save(folder / f"{name}.png", np.repeat(np.where(counts, np.uint8(255), np.uint8(0))[..., None], 3, 2))
    watch(len(views), len(views))
    return None if everything else folder


def features_of(views: Sequence[View]) -> Features:
    """Returns the settings of feature extraction: with smaller features for few or small photos."""
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    return Features(first_octave=-1) if longest <= SMALL else features_for(len(views))


def over_black(pixels: Pixels) -> Pixels:
    """Returns RGB; colours with alpha are composited over black."""
    if pixels.shape[2] == 3:
        return pixels
    return np.round(pixels[..., :3] * (pixels[..., 3:] / 255.0)).astype(np.uint8)


def register(database: "pycolmap.Database", model: "pycolmap.Reconstruction") -> None:
    """Writes the cameras and photos of a model to an empty database, under their numbers."""
    import pycolmap

    with pycolmap.DatabaseTransaction(database):
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            database.write_frame(frame, use_frame_id=True)
        for image in model.images.values():
            database.write_image(image, use_image_id=True)
