"""Runs COLMAP's three steps through pycolmap: features of photos, matches of pairs, poses of all photos.

The database keeps finished work, so each step continues where an earlier call was stopped. Steps process
a few photos or pairs at a time, so that they can report progress.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from splatax.reconstruction.pairs import Pairing

if TYPE_CHECKING:
    import pycolmap

PHOTOS_AT_ONCE, PAIRS_AT_ONCE = 16, 128
FIRST_PHOTOS = 4  # whose time tells how long all take
FEWEST_IN_MODEL = 3  # photos
MANY = 20  # photos of one camera from which its tangential distortion is estimated too
UNKNOWN_FOCAL = 1.2  # focal length over the longer side if EXIF has none (as in COLMAP)


@dataclass(frozen=True)
class Features:
    """Settings of feature extraction.

    Attributes:
        longest_side: size to which photos are shrunk, pixels of the longer side.
        most: largest number of features in a photo.
        first_octave: first octave of the scale space; -1 upsamples photos by 2 and takes four times as long.
    """

    longest_side: int = 1600
    most: int = 8192
    first_octave: int = 0


@dataclass(frozen=True)
class Entry:
    """Photo in COLMAP's database: upright, shrunk, and named by its number."""

    name: str
    size: tuple[int, int]
    focal: float | None  # pixels
    device: str


@contextmanager
def opened(path: Path) -> "Iterator[pycolmap.Database]":
    import pycolmap

    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def register(database: "pycolmap.Database", entries: Sequence[Entry]) -> None:
    """Writes photos and their cameras to an empty database.

    They are written in order, so that their numbers do not depend on the timing of threads. Photos of one
    device and size share a camera.
    """
    import pycolmap

    devices: dict[tuple[str, tuple[int, int]], list[Entry]] = {}
    for entry in entries:
        devices.setdefault((entry.device, entry.size), []).append(entry)
    with pycolmap.DatabaseTransaction(database):
        rigs = {key: write_camera(database, group) for key, group in devices.items()}
        for entry in entries:
            camera, rig = rigs[entry.device, entry.size]
            image = database.read_image(
                database.write_image(pycolmap.Image(name=entry.name, camera_id=camera))
            )
            frame = pycolmap.Frame()
            frame.rig_id = rig
            frame.add_data_id(image.data_id)
            database.write_frame(frame)


def write_camera(database: "pycolmap.Database", group: Sequence[Entry]) -> tuple[int, int]:
    """Writes the camera of photos from one device, starting from EXIF's focal length.

    Returns:
        The numbers of (camera, rig).
    """
    import pycolmap

    (width, height), focal = group[0].size, group[0].focal
    model = "OPENCV" if len(group) > MANY else "SIMPLE_RADIAL"
    start = focal or UNKNOWN_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(0, model, start, width, height)
    camera.has_prior_focal_length = focal is not None
    camera = database.read_camera(database.write_camera(camera))
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera.camera_id, database.write_rig(rig)


def extract(
    path: Path,
    photos: Path,
    features: Features,
    watch: Callable[[int, int], None],
    masks: Path | None = None,
) -> None:
    """Extracts SIFT features (Lowe 2004) of the photos that have none yet, on the CPU.

    Args:
        path: of the database.
        photos: folder of the photos.
        features: settings.
        watch: function that is called with (photos done, all photos).
        masks: folder of masks, named after their photo with ".png" at the end. Black pixels have no features.
    """
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    if masks:
        reading.mask_path = masks
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = features.longest_side
    options.sift.max_num_features = features.most
    options.sift.first_octave = features.first_octave
    with opened(path) as database:
        every = sorted(database.read_all_images(), key=lambda image: image.image_id)
        left = [image.name for image in every if not database.exists_keypoints(image.image_id)]
    starts = [0, *range(FIRST_PHOTOS, len(left), PHOTOS_AT_ONCE), len(left)]
    for start, end in pairwise(starts if left else []):
        watch(len(every) - len(left) + start, len(every))
        names = left[start:end]
        pycolmap.extract_features(
            path,
            photos,
            image_names=names,
            reader_options=reading,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
    watch(len(every), len(every))


def match(path: Path, pairing: Pairing, seed: int, watch: Callable[[int, int], None]) -> int:
    """Matches the pairs that have not been matched yet, keeping matches that agree with one motion.

    Returns:
        The number of pairs that were matched.
    """
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    with opened(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ids = sorted(names)
        pairs = [(ids[i], ids[j]) for i, j in pairing.pairs(database, ids)]
        left = [pair for pair in pairs if not database.exists_two_view_geometry(*pair)]
    listed = path.with_name("pairs.txt")
    importing = pycolmap.ImportedPairingOptions()
    importing.match_list_path = listed
    for start in range(0, len(left), PAIRS_AT_ONCE):
        watch(len(pairs) - len(left) + start, len(pairs))
        chunk = left[start : start + PAIRS_AT_ONCE]
        listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in chunk))
        pycolmap.match_image_pairs(
            path, pairing_options=importing, verification_options=verification, device=pycolmap.Device.cpu
        )
    watch(len(pairs), len(pairs))
    return len(left)


def place(
    path: Path, photos: Path, out: Path, seed: int, watch: Callable[[int, int], None]
) -> "list[pycolmap.Reconstruction]":
    """Finds poses and points by incremental structure from motion (Schönberger and Frahm 2016).

    If the output folder exists, an earlier call has finished, and its result is read.

    Returns:
        Parts that are not connected with each other, the one with the most photos first; empty if no two
        photos fit together.
    """
    import pycolmap

    with opened(path) as database:
        count = database.num_images()
    if out.exists():
        watch(count, count)
        return _largest_first(pycolmap.Reconstruction(part) for part in sorted(out.iterdir()))
    placed = 0

    def one_more(step: int = 1) -> None:
        nonlocal placed
        placed = min(placed + step, count)
        watch(placed, count)

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.min_model_size = FEWEST_IN_MODEL
    pycolmap.set_random_seed(seed)
    unfinished = out.with_name(f"{out.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    parts = pycolmap.incremental_mapping(
        path,
        photos,
        unfinished,
        options=options,
        initial_image_pair_callback=lambda: one_more(2),
        next_image_callback=one_more,
    )
    unfinished.rename(out)
    return _largest_first(parts.values())


def _largest_first(parts: "Iterable[pycolmap.Reconstruction]") -> "list[pycolmap.Reconstruction]":
    return sorted(parts, key=lambda part: -part.num_reg_images())
