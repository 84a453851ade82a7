"""Reconstructs a capture from photos, in stages that can be interrupted and continued."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from splatax.errors import DatasetError
from splatax.io.video import is_video
from splatax.packages import required_by
from splatax.reconstruction import diagnosis, mapping, refusals
from splatax.reconstruction.mapping import Entry, Features
from splatax.reconstruction.pairs import Exhaustive, Pairing, Sequential, Similar
from splatax.reconstruction.panoramas import FACES, SEARCHED, Panoramas, faces_of, size_of_faces
from splatax.reconstruction.photos import Photo, photos_in, read, save
from splatax.reconstruction.video import pick_frames
from splatax.reconstruction.work import (
    DATABASE,
    RESULTS,
    WORK,
    fingerprint,
    prepared,
    refuse_overlap,
    replaceable_if_refused,
    take_back_results,
)
from splatax.reconstruction.writing import Ways, write_capture
from splatax.resampling import resize

FEW = 80  # photos up to which every pair is matched
VERY_FEW = 30  # photos up to which smaller features are used too: 2.5 times the points and 0.5 dB on fern
PANORAMAS = "360 degrees"  # the device of all panoramas, which differ in nothing but size
STAGES = ("reading", "features", "matches", "poses", "writing")
Watch = Callable[[str, int, int], None]  # stage, finished parts, all parts


@dataclass(frozen=True)
class Outcome:
    """Outcome of a reconstruction.

    Attributes:
        registered: names of the photos with a pose.
        rejected: reasons why the other photos, and videos among them, have none, by name.
        points: number of points.
        error: mean reprojection error, pixels of the written photos.
        panoramas: number of 360-degree photos with a pose.
        wide: number of photos that may show 360 degrees, though their metadata do not say so.
    """

    registered: tuple[str, ...]
    rejected: dict[str, str]
    points: int
    error: float
    panoramas: int = 0
    wide: int = 0


@required_by("splatax.reconstruction")
def reconstruct(
    source: Path,
    out: Path,
    *,
    frames: int = 200,
    features: Features | None = None,
    pairing: Pairing | None = None,
    seed: int = 0,
    panoramas: Panoramas = "auto",
    faces: bool = True,
    undistort: bool = False,
    watch: Watch = lambda stage, done, total: None,
) -> Outcome:
    """Finds poses and points, and writes the photos and a COLMAP model to a folder.

    An interrupted call leaves its work in the folder. The next call continues from there if the photos have
    not changed; otherwise it starts again.

    Args:
        source: folder of photos, or a video.
        out: folder for the capture.
        frames: number of frames to take from a video.
        features: settings of feature extraction. None uses smaller features too if there are very few photos.
        pairing: selection of pairs to match. None matches all pairs of few photos, similar ones of many
            photos, and neighbours in a video.
        seed: random seed.
        panoramas: which of the photos that are twice as wide as high show 360 degrees: those whose metadata
            say so ("auto"), "all", or "none".
        faces: writes 360-degree photos as the faces of a cube, pinhole photos of 90 degrees. Otherwise they
            are copied, and the model has the lens of panoramas.
        undistort: resamples the other photos for pinhole cameras, for programs that know no other.
            Otherwise photos are copied, and the model has their lens.
        watch: function that is called with the progress of each of `STAGES`.

    Raises:
        InputError: if the output folder holds something else, a package to read the input is missing, or
            panoramas are to be copied and undistorted.
        DatasetError: if there are no photos, or too few of them fit together.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    work, ways = out / WORK, Ways(faces, undistort)
    refuse_overlap(source, out)
    take_back_results(out)
    refusals.existing_results(out)
    asked = asdict(features) if features else "auto"
    settings = {"source": str(source.resolve()), "frames": frames, "features": asked, "seed": seed}
    settings |= {"panoramas": panoramas, "faces": faces, "undistort": undistort}
    with prepared(out, settings | {"photos": fingerprint(source)}):
        found, rejected = gather(source, work, frames, panoramas, partial(watch, "reading"))
        refusals.undistorted_panoramas(source, found, ways)
        features = features or features_for(len(found))
        photos, damaged = shrink(found, work / "photos", features.longest_side, partial(watch, "reading"))
        rejected |= damaged
        refusals.too_few(source, photos, rejected)
    database = register(work, photos, features)
    mapping.extract(database, work / "photos", features, partial(watch, "features"))
    if mapping.match(database, pairing or pairing_for(source, len(photos)), seed, partial(watch, "matches")):
        shutil.rmtree(work / "models", ignore_errors=True)  # they were made without these pairs
    parts = mapping.place(database, work / "photos", work / "models", seed, partial(watch, "poses"))
    reasons = diagnosis.reasons(database, parts)
    rejected |= diagnosis.by_photo({name: photo.name for name, photo in photos.items()}, reasons)
    with replaceable_if_refused(work):
        refusals.too_few_placed(source, parts, photos, rejected)
    registered = {photos[parts[0].image(i).name] for i in parts[0].reg_image_ids()}
    capture = write_capture(parts[0], photos, work / "capture", partial(watch, "writing"), ways)
    for name in reversed(RESULTS):
        (work / "capture" / name).rename(out / name)
    shutil.rmtree(work)
    return Outcome(
        tuple(sorted(photo.name for photo in registered)),
        rejected,
        capture.num_points3D(),
        capture.compute_mean_reprojection_error(),
        sum(photo.panorama for photo in registered),
        refusals.wide_of(photos),
    )


def gather(
    source: Path, work: Path, frames: int, panoramas: Panoramas, watch: Callable[[int, int], None]
) -> tuple[list[Photo], dict[str, str]]:
    """Returns the photos of a folder or a video, and the reasons why others cannot be used, by name."""
    if source.is_dir():
        return photos_in(source, panoramas)
    if not (work / "frames").exists():
        shutil.rmtree(work / "frames.part", ignore_errors=True)
        pick_frames(source, work / "frames.part", frames, watch)
        (work / "frames.part").rename(work / "frames")
    return photos_in(work / "frames", panoramas)


def shrink(
    photos: list[Photo], folder: Path, longest_side: int, watch: Callable[[int, int], None]
) -> tuple[dict[str, Photo], dict[str, str]]:
    """Writes the pictures for feature extraction: upright, shrunk, and named by number; panoramas as faces.

    Returns:
        The photos by the names of their pictures, and the reasons why others cannot be read, by photo name.
    """
    shrunk: dict[str, Photo] = {}
    damaged = {}
    for number, photo in enumerate(photos):
        watch(number, len(photos))
        wanted = names_of(number, photo)
        try:
            if not all((folder / name).exists() for name in wanted):
                pixels, size = read(photo), shrunk_size(photo, longest_side)
                cut = faces_of(pixels, size[0], SEARCHED) if photo.panorama else [resize(pixels, *size)]
                for name, small in zip(wanted, cut, strict=True):
                    save(folder / f"{name}.part", small)
                    (folder / f"{name}.part").rename(folder / name)
            shrunk |= dict.fromkeys(wanted, photo)
        except DatasetError as error:
            damaged[photo.name] = f"cannot be read: {error}"
    watch(len(photos), len(photos))
    return shrunk, damaged


def names_of(number: int, photo: Photo) -> list[str]:
    """Returns the names of a photo's pictures: those of its faces, for a panorama."""
    return [f"{number:06}-{face.name}.jpg" for face in FACES] if photo.panorama else [f"{number:06}.jpg"]


def shrunk_size(photo: Photo, longest_side: int) -> tuple[int, int]:
    """Returns the width and height of a photo's pictures for feature extraction."""
    if photo.panorama:
        size = min(size_of_faces(photo.size[0], SEARCHED), longest_side)
        return size, size
    factor = min(1.0, longest_side / max(photo.size))
    width, height = (max(1, round(side * factor)) for side in photo.size)
    return width, height


def register(work: Path, photos: dict[str, Photo], features: Features) -> Path:
    """Returns COLMAP's database of the photos, and makes it unless an interrupted call has."""
    database = work / DATABASE
    if not database.exists():
        (work / "new.db").unlink(missing_ok=True)
        with mapping.opened(work / "new.db") as empty:
            mapping.register(empty, moments_of(photos, features))
        (work / "new.db").replace(database)
    return database


def moments_of(photos: dict[str, Photo], features: Features) -> list[list[Entry]]:
    """Returns the database's entries of each photo, from photos by the names of their pictures."""
    moments: dict[Photo, list[Entry]] = {}
    for name, photo in photos.items():
        moments.setdefault(photo, []).append(entry_of(name, photo, features))
    return [
        [replace(entry, face=face, device=PANORAMAS) for entry, face in zip(entries, FACES, strict=True)]
        if photo.panorama
        else entries
        for photo, entries in moments.items()
    ]


def entry_of(name: str, photo: Photo, features: Features) -> Entry:
    """Returns the database's entry of a photo's picture."""
    size = shrunk_size(photo, features.longest_side)
    focal = photo.focal * max(size) / max(photo.size) if photo.focal else None
    return Entry(name, size, focal, photo.device)


def features_for(count: int) -> Features:
    """Returns the settings of feature extraction for a number of photos."""
    return Features(first_octave=-1) if count <= VERY_FEW else Features()


def pairing_for(source: Path, count: int) -> Pairing:
    """Returns the selection of pairs for a video, few photos, or many photos."""
    if count <= FEW:
        return Exhaustive()
    return Sequential() if is_video(source) else Similar()
