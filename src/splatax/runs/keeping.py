"""The place for decoded photos that do not fit in memory: on disk, in a folder of the user."""

import os
from dataclasses import replace
from pathlib import Path

from splatax.dataset import Dataset
from splatax.errors import InputError
from splatax.io.files import explained
from splatax.io.photo_store import PhotoStore, kept_on_disk
from splatax.runs import forecast
from splatax.runs.budget import parse_bytes
from splatax.runs.planning import Room, gigabytes

PLACE, SIZE = "SPLATAX_CACHE", "SPLATAX_CACHE_SIZE"  # environment variables
MOST = "50GB"


def user_store() -> PhotoStore | None:
    """Returns the store of decoded photos of this user; None if its size is set to 0.

    Its folder is splatax/photos in $SPLATAX_CACHE, else in $XDG_CACHE_HOME or ~/.cache: a folder of its own,
    since the store removes what is in it. It takes at most $SPLATAX_CACHE_SIZE, else 50 GB.

    Raises:
        InputError: if the environment variable for the size makes no sense.
    """
    size = os.environ.get(SIZE) or MOST
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = Path(os.environ.get(PLACE) or caches) / "splatax" / "photos"
    if size.strip() == "0":
        return None
    try:
        return PhotoStore(folder, parse_bytes(size))
    except ValueError as error:
        raise InputError(f"{SIZE}={size}: {error}. Correct the environment variable, or unset it.") from error


def with_photos_kept(dataset: Dataset, room: Room) -> tuple[Dataset, str]:
    """Returns a capture whose training photos are kept on disk where they do not fit in memory.

    The photos are the same in any case. They are not kept if the folder cannot be made.

    Returns:
        The capture, and a line about it, which is empty if all photos fit in memory.
    """
    wanted = forecast.photos(dataset)[2]
    if wanted <= room.photos:
        return dataset, ""
    store = user_store()
    again = "are decoded again for each step"
    part = f"{gigabytes(wanted)} of photos do not fit in {gigabytes(room.photos)} of memory, so"
    if store is None:
        return dataset, f"{part} the others {again}: {SIZE} is 0"
    try:
        views, use = kept_on_disk(dataset.train, store)
    except OSError as error:
        return dataset, f"{part} the others {again}: {explained(error)} Name another folder: {PLACE}"
    left = f"; {use.photos - use.kept:,} {again}. Allow more: {SIZE}=100GB" if use.kept < use.photos else ""
    line = (
        f"{part} {use.kept:,} of {use.photos:,} are kept decoded on disk: at most {gigabytes(use.size)} in "
        f"{use.folder}{left}"
    )
    return replace(dataset, train=views), line
