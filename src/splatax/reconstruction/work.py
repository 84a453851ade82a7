"""Working folder of a reconstruction, which keeps finished work unless the photos change."""

import hashlib
import json
import shutil
from pathlib import Path

from splatax.errors import DatasetError, InputError
from splatax.io.damage import blamed_on
from splatax.io.datasets.photos import counted, listed
from splatax.io.files import write_whole
from splatax.reconstruction.photos import is_photo, unread
from splatax.reconstruction.video import is_video

RESULTS = ("sparse", "images")
WORK = ".reconstruction"  # working folder inside the capture's folder
BEGUN = ("frames", "database.db")  # in the working folder, once there is work to lose


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
    inside, whole = out.resolve(), source.resolve()
    if whole.is_dir() and inside.is_relative_to(whole):
        raise InputError(f"{out}: lies among the photos. Choose a folder outside {source}.")
    if whole.is_relative_to(inside / "images"):
        raise InputError(f"{out}: its images/ holds the photos themselves. Choose another folder.")


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
        paths = sorted(path for path in source.rglob("*") if path.is_file() and is_photo(path))
        if not paths:
            if other := unread([path for path in source.rglob("*") if path.is_file()], []):
                raise DatasetError(
                    f"{source}: {counted(len(other))} in formats that splatax does not know: "
                    f"{listed(path.name for path in other)}. Save them as JPEG or PNG."
                )
            raise DatasetError(
                f"{source}: no photos in this folder. Give the folder they are in, or a video."
            )
    elif not is_video(source):
        raise InputError(f"{source}: neither a folder of photos nor a video.")
    stats = [(path.relative_to(source).as_posix(), path.stat()) for path in paths]
    listing = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    return hashlib.sha256(json.dumps(listing).encode()).hexdigest()


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
        if changed - {"photos"} and any((work / name).exists() for name in BEGUN):
            raise InputError(
                f"{work.parent}: holds an unfinished reconstruction with other settings. Choose another "
                "folder, or remove this one.",
                options=("out", "overwrite"),
            )
        shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(settings, indent=1).encode())
