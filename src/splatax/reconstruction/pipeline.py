"""Reconstructs a capture from photos, in stages that can be interrupted and continued."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from splatax.errors import DatasetError, InputError
from splatax.io.datasets.photos import counted
from splatax.packages import required_by
from splatax.reconstruction import diagnosis, mapping
from splatax.reconstruction.mapping import Entry, Features
from splatax.reconstruction.pairs import Exhaustive, Pairing, Sequential, Similar
from splatax.reconstruction.photos import Photo, photos_in, read, save
from splatax.reconstruction.video import is_video, pick_frames
from splatax.reconstruction.work import (
    RESULTS,
    WORK,
    fingerprint,
    prepare,
    refuse_overlap,
    take_back_results,
)
from splatax.reconstruction.writing import write_capture
from splatax.resampling import resize

FEW = 80  # photos up to which every pair is matched
VERY_FEW = 30  # photos up to which smaller features are used too: 2.5 times the points and 0.5 dB on fern
FEWEST, LEAST_SHARE = 3, 0.5  # number and fraction of photos that must get a pose
STAGES = ("reading", "features", "matches", "poses", "writing")
Watch = Callable[[str, int, int], None]  # stage, finished parts, all parts


@dataclass(frozen=True)
class Outcome:
    """Outcome of a reconstruction.

    Attributes:
        registered: names of the photos with a pose.
        rejected: reasons why the other photos have none, by name.
        points: number of points.
        error: mean reprojection error, pixels of the written photos.
    """

    registered: tuple[str, ...]
    rejected: dict[str, str]
    points: int
    error: float


@required_by("splatax.reconstruction")
def reconstruct(
    source: Path,
    out: Path,
    *,
    frames: int = 200,
    features: Features | None = None,
    pairing: Pairing | None = None,
    seed: int = 0,
    watch: Watch = lambda stage, done, total: None,
) -> Outcome:
    """Finds poses and points, and writes undistorted photos and a COLMAP model to a folder.

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
        watch: function that is called with the progress of each of `STAGES`.

    Raises:
        InputError: if the output folder holds something else, or a package to read the input is missing.
        DatasetError: if there are no photos, or too few of them fit together.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    work = out / WORK
    refuse_overlap(source, out)
    take_back_results(out)
    if any((out / name).exists() for name in RESULTS):
        raise InputError(
            f"{out}: holds a capture. Choose another folder, or remove this one.",
            options=("out", "overwrite"),
        )
    asked = asdict(features) if features else "auto"
    settings = {"source": str(source.resolve()), "frames": frames, "features": asked, "seed": seed}
    prepare(work, settings | {"photos": fingerprint(source)})
    found, rejected = gather(source, work, frames, partial(watch, "reading"))
    features = features or features_for(len(found))
    photos, damaged = shrink(found, work / "photos", features.longest_side, partial(watch, "reading"))
    rejected |= damaged
    if len(photos) < FEWEST:
        why = f" ({len(rejected)} cannot be read, such as {next(iter(rejected))})" if rejected else ""
        raise DatasetError(
            f"{source}: {counted(len(photos))} to use{why}, but depth needs at least {FEWEST}, better 30 or "
            "more, from different places."
        )
    database = work / "database.db"
    if not database.exists():
        entries = [entry_of(name, photo, features) for name, photo in photos.items()]
        (work / "new.db").unlink(missing_ok=True)
        with mapping.opened(work / "new.db") as empty:
            mapping.register(empty, entries)
        (work / "new.db").replace(database)
    mapping.extract(database, work / "photos", features, partial(watch, "features"))
    pairing = pairing or pairing_for(source, len(photos))
    if mapping.match(database, pairing, seed, partial(watch, "matches")):
        shutil.rmtree(work / "models", ignore_errors=True)  # they were made without these pairs
    parts = mapping.place(database, work / "photos", work / "models", seed, partial(watch, "poses"))
    reasons = diagnosis.reasons(database, parts)
    rejected |= {photos[name].name: reason for name, reason in reasons.items()}
    placed = parts[0].num_reg_images() if parts else 0
    if placed < max(FEWEST, LEAST_SHARE * len(photos)):
        raise DatasetError(
            f"{source}: only {placed} of {len(photos)} photos fit together; {most_frequent(rejected)}. "
            f"{diagnosis.advice(rejected)}"
        )
    registered = sorted(photos[parts[0].image(i).name].name for i in parts[0].reg_image_ids())
    write_capture(parts[0], photos, work / "capture", partial(watch, "writing"))
    for name in reversed(RESULTS):
        (work / "capture" / name).rename(out / name)
    outcome = Outcome(
        tuple(registered),
        rejected,
        parts[0].num_points3D(),
        parts[0].compute_mean_reprojection_error(),
    )
    shutil.rmtree(work)
    return outcome


def gather(
    source: Path, work: Path, frames: int, watch: Callable[[int, int], None]
) -> tuple[list[Photo], dict[str, str]]:
    """Returns the photos of a folder or a video, and the reasons why others cannot be used, by name."""
    if source.is_dir():
        return photos_in(source)
    if not (work / "frames").exists():
        shutil.rmtree(work / "frames.part", ignore_errors=True)
        pick_frames(source, work / "frames.part", frames, watch)
        (work / "frames.part").rename(work / "frames")
    return photos_in(work / "frames")


def shrink(
    photos: list[Photo], folder: Path, longest_side: int, watch: Callable[[int, int], None]
) -> tuple[dict[str, Photo], dict[str, str]]:
    """Writes the pictures for feature extraction: upright, shrunk, and named by number.

    Returns:
        The photos by the names of their pictures, and the reasons why others cannot be read, by photo name.
    """
    shrunk, damaged = {}, {}
    for number, photo in enumerate(photos):
        watch(number, len(photos))
        name = f"{number:06}.jpg"
        try:
            if not (folder / name).exists():
                width, height = shrunk_size(photo, longest_side)
                save(folder / f"{name}.part", resize(read(photo), width, height))
                (folder / f"{name}.part").rename(folder / name)
            shrunk[name] = photo
        except DatasetError as error:
            damaged[photo.name] = f"cannot be read: {error}"
    watch(len(photos), len(photos))
    return shrunk, damaged


def shrunk_size(photo: Photo, longest_side: int) -> tuple[int, int]:
    factor = min(1.0, longest_side / max(photo.size))
    width, height = (max(1, round(side * factor)) for side in photo.size)
    return width, height


def entry_of(name: str, photo: Photo, features: Features) -> Entry:
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


def most_frequent(rejected: dict[str, str]) -> str:
    """Describes the most frequent reason, such as "of the others, 7: overlaps with no other photo"."""
    reasons = list(rejected.values())
    if not reasons:
        return "no two show the same from different places"
    top = max(sorted(set(reasons)), key=reasons.count)
    return f"of the others, {reasons.count(top)}: {top}"
