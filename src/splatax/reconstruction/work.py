"""Working folder of a reconstruction, which keeps finished work unless the photos change."""

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from splatax.errors import DatasetError, InputError
from splatax.io.damage import blamed_on
from splatax.io.datasets.photos import counted, listed
from splatax.io.files import write_whole
from splatax.io.video import is_video
from splatax.reconstruction.photos import files_of

RESULTS = ("sparse", "images")
WORK = ".reconstruction"  # working folder inside the capture's folder
DATABASE = "database.db"  # in the working folder, once photos were accepted
BEGUN = ("frames", DATABASE)  # in the working folder, once there is work to lose
REFUSED = "refused"  # beside them, if the photos did not fit together, so that other settings may start again


def clear(source: Path, out: Path) -> None:
    """Removes the results and the working folder of an earlier call.

    Raises:
        InputError: if they could be the photos themselves.
    """
    refuse_overlap(source, out)
    for name in (*RESULTS, WORK):
        shutil.rmtree(out / name, ignore_errors=True)


def refuse_overlap(source: Path, out: Path) -> None:
    """Refuses an output folder that overlaps the photos, because results could replace them or mix with them.

    Raises:
        InputError: if the folders overlap, or the photos do not exist.
    """
    if not source.exists():
        raise InputError(f"{source}: no such folder or video.")
    refuse_among(source, out)
    if source.resolve().is_relative_to(out.resolve() / "images"):
        raise InputError(f"{out}: its images/ holds the photos themselves. Choose another folder.")


def refuse_among(photos: Path, out: Path) -> None:
    """Refuses an output folder that is a folder of photos, or lies in one.

    Raises:
        InputError: if it does.
    """
    if photos.is_dir() and out.resolve().is_relative_to(photos.resolve()):
        raise InputError(f"{out}: lies among the photos. Choose a folder outside {photos}.", options=("out",))


def take_back_results(out: Path) -> None:
    """Undoes the first of the two moves that finish a call, if the call was stopped between them."""
    made = out / WORK / "capture"
    if (made / "sparse").exists() and not (made / "images").exists() and (out / "images").exists():
        (out / "images").rename(made / "images")


def fingerprint(source: Path) -> str:
    """Hashes the names, sizes and times of photos or of a video, to detect changes.

    Raises:
        DatasetError: if there are no photos in the folder.
        InputError: if the path is neither a folder nor a video.
    """
    paths = [source]
    if source.is_dir():
        paths, unused = files_of(source)
        if not paths:
            refuse_without_photos(source, list(unused))
    elif not is_video(source):
        raise InputError(f"{source}: neither a folder of photos nor a video.")
    stats = [(path.relative_to(source).as_posix(), path.stat()) for path in paths]
    listing = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    return hashlib.sha256(json.dumps(listing).encode()).hexdigest()


def refuse_without_photos(folder: Path, unused: list[Path]) -> NoReturn:
    """Refuses a folder in which no file is a photo that can be used, and names those that could become one.

    Args:
        folder: the folder.
        unused: its videos, and its photos in other formats.

    Raises:
        DatasetError: always.
    """
    videos = [path for path in unused if is_video(path)]
    if other := [path.name for path in unused if not is_video(path)]:
        raise DatasetError(
            f"{folder}: {counted(len(other))} in formats that splatax does not know: {listed(other)}. Save "
            "them as JPEG or PNG."
        )
    if videos:
        raise DatasetError(
            f"{folder}: no photos in this folder, but {counted(len(videos), 'video')}. Give the video "
            f"itself, such as {videos[0]}."
        )
    raise DatasetError(f"{folder}: no photos in this folder. Give the folder they are in, or a video.")


@contextmanager
def prepared(out: Path, settings: dict) -> Iterator[None]:
    """Prepares the working folder, and removes it if the input is refused inside.

    Work on photos that were accepted is kept.

    Raises:
        InputError: if the folder holds work with other settings.
    """
    work, new = out / WORK, not out.exists()
    prepare(work, settings)
    try:
        yield
    except InputError:
        if not (work / DATABASE).exists():
            shutil.rmtree(work, ignore_errors=True)
            if new:
                with suppress(OSError):
                    out.rmdir()
        raise


@contextmanager
def replaceable_if_refused(work: Path) -> Iterator[None]:
    """Lets a call with other settings replace the working folder if the photos are refused inside."""
    try:
        yield
    except DatasetError:
        (work / REFUSED).touch()
        raise


def prepare(work: Path, settings: dict) -> None:
    """Creates the working folder, or continues that of an earlier call.

    Work for photos that have changed since is removed.

    Raises:
        InputError: if the folder holds work with other settings.
    """
    path = work / "settings.json"
    earlier = {}
    if path.exists():
        way_out = "Choose another folder, or remove this one."
        with blamed_on(path, "damaged, so what was begun cannot be continued", way_out, InputError):
            earlier = dict(json.loads(path.read_text()))
    if earlier != settings:
        changed = {name for name in settings if earlier.get(name) != settings[name]}
        unfinished = not (work / REFUSED).exists() and any((work / name).exists() for name in BEGUN)
        if changed - {"photos"} and unfinished:
            raise InputError(
                f"{work.parent}: holds an unfinished reconstruction with other settings. Choose another "
                "folder, or remove this one.",
                options=("out", "overwrite"),
            )
        shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    (work / REFUSED).unlink(missing_ok=True)
    write_whole(path, json.dumps(settings, indent=1).encode())
