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

import numpy as np

from splatax.reconstruction.pairs import Pairing
from splatax.reconstruction.panoramas import FACES, SEARCHED, Face, focal_of_faces

if TYPE_CHECKING:
    import pycolmap

PHOTOS_AT_ONCE, PAIRS_AT_ONCE = 16, 128
FIRST_PHOTOS = 4  # from whose time that of all is estimated
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
    """Photo in COLMAP's database: upright, shrunk, and named by its number.

    Attributes:
        name: of its file.
        size: width and height, pixels.
        focal: focal length from EXIF, pixels; None if EXIF has none.
        device: photos of one device and size share a camera.
        face: of a panorama, that this is; None for a photo.
    """

    name: str
    size: tuple[int, int]
    focal: float | None
    device: str
    face: Face | None = None


@contextmanager
def opened(path: Path) -> "Iterator[pycolmap.Database]":
    import pycolmap

    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def register(database: "pycolmap.Database", moments: Sequence[Sequence[Entry]]) -> None:
    """Writes photos and their cameras to an empty database.

    They are written in order, so that their numbers do not depend on the timing of threads. Photos of one
    device and size share a camera.

    Args:
        database: empty.
        moments: the photos of each moment: a single one, or the faces of a panorama, all of `FACES` in order.
    """
    import pycolmap

    devices: dict[tuple[str, tuple[int, int]], list[Sequence[Entry]]] = {}
    for entries in moments:
        devices.setdefault((entries[0].device, entries[0].size), []).append(entries)
    with pycolmap.DatabaseTransaction(database):
        rigs = {key: write_rig(database, group) for key, group in devices.items()}
        for entries in moments:
            rig, cameras = rigs[entries[0].device, entries[0].size]
            frame = pycolmap.Frame()
            frame.rig_id = rig
            for entry, camera in zip(entries, cameras, strict=True):
                image = pycolmap.Image(name=entry.name, camera_id=camera)
                frame.add_data_id(database.read_image(database.write_image(image)).data_id)
            database.write_frame(frame)


def write_rig(database: "pycolmap.Database", group: Sequence[Sequence[Entry]]) -> tuple[int, list[int]]:
    """Writes the cameras of photos from one device, as a rig: a single one, or those of the faces.

    Returns:
        The number of the rig, and those of its cameras.
    """
    import pycolmap

    rig, numbers = pycolmap.Rig(), []
    if group[0][0].face is None:
        camera = write_camera(database, [entry for entries in group for entry in entries])
        rig.add_ref_sensor(camera.sensor_id)
        return database.write_rig(rig), [camera.camera_id]
    (size, _), middle = group[0][0].size, group[0][0].size[0] / 2
    for face in FACES:
        params = [focal_of_faces(size, SEARCHED), middle, middle]
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=size, height=size, params=params)
        camera.has_prior_focal_length = True
        camera = database.read_camera(database.write_camera(camera))
        numbers.append(camera.camera_id)
        if face is FACES[0]:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            turned = pycolmap.Rotation3d(np.array(face.rotation, float))
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(turned, np.zeros(3)))
    return database.write_rig(rig), numbers


def write_camera(database: "pycolmap.Database", group: Sequence[Entry]) -> "pycolmap.Camera":
    """Writes the camera of photos from one device, starting from EXIF's focal length, and returns it."""
    import pycolmap

    (width, height), focal = group[0].size, group[0].focal
    model = "OPENCV" if len(group) > MANY else "SIMPLE_RADIAL"
    start = focal or UNKNOWN_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(0, model, start, width, height)
    camera.has_prior_focal_length = focal is not None
    return database.read_camera(database.write_camera(camera))


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
        frames = {data.id: frame.frame_id for frame in database.read_all_frames() for data in frame.data_ids}
        ids = sorted(names)
        every = [(ids[i], ids[j]) for i, j in pairing.pairs(database, ids)]
        # Faces of one panorama were taken from one place, so their matches say nothing about depth.
        pairs = [(a, b) for a, b in every if frames[a] != frames[b]]
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
        frames, rigs = database.read_all_frames(), database.read_all_rigs()
    count = len(frames)
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
    panoramas = [rig for rig in rigs if rig.num_sensors() > 1]
    options.ba_refine_sensor_from_rig = False
    options.constant_cameras = {sensor.id for rig in panoramas for sensor in rig.sensor_ids()}
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
    return sorted(parts, key=lambda part: -part.num_reg_frames())
