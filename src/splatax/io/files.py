"""Files that are written whole or not at all, and only inside the folder that they are meant for."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from splatax.errors import InputError

REASONS = {  # why a file cannot be used, and the way out
    errno.EEXIST: "a file, where a folder is needed. Choose another place.",
    errno.ENOTDIR: "lies below a file, where a folder is needed. Choose another place.",
    errno.EISDIR: "a folder, where a file is needed. Choose another name.",
    errno.EACCES: "not permitted. Choose a place that you may use.",
    errno.EPERM: "not permitted. Choose a place that you may use.",
    errno.EROFS: "cannot be written to ({disk}, is read-only). Choose another place.",
    errno.ENOSPC: "no space is left ({disk}). Free some, and run it again.",
    errno.EDQUOT: "your quota is used up ({disk}). Free some space, and run it again.",
    errno.EFBIG: "larger than files may be here ({disk}). Raise the limit, or choose another place.",
    errno.EIO: "the disk failed ({disk}). Choose another place.",
}


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Opens a file that replaces `path` once all of it is on the disk.

    A crash or a full disk leaves the old file as it was.

    Raises:
        OSError: if the file cannot be written; `filename` is `path`.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        # The system names no file when a write fails.
        if error.errno is not None and str(error.filename) in ("None", str(temporary)):
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):  # where it could not be written, it often cannot be removed
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, contents: bytes) -> None:
    """Replaces the contents of a file in one moment; see `replacing`."""
    with replacing(path) as file:
        file.write(contents)


def path_inside(folder: Path, name: str) -> Path:
    """Returns the path of the file `name` in an output folder, where `name` comes from a capture.

    Every command that names its output files after views uses this function, so that no capture can make
    it write elsewhere.

    Args:
        folder: of the output; it need not exist.
        name: relative, with `/` between its parts.

    Raises:
        InputError: if the file would lie outside the folder, also by way of a symbolic link.
    """
    relative = Path(name)
    leaves = relative.is_absolute() or relative.drive or relative.root or ".." in relative.parts
    if leaves or "\0" in name or not relative.name:
        raise InputError(
            f"{name}: a view of this name would be written outside {folder}. Rename the photo in the capture."
        )
    path = folder / relative
    if not path.parent.resolve().is_relative_to(folder.resolve()):
        raise InputError(
            f"{path}: a symbolic link leads outside {folder}. Remove the link, or choose another folder."
        )
    return path


def disk_of(path: Path) -> str:
    """Returns where the disk of a file is mounted and how much of it is free, in words.

    Args:
        path: of a file or folder; it need not exist.
    """
    place = Path(os.path.abspath(path))
    try:
        while not place.exists() or not os.path.ismount(place):
            if place == place.parent:
                break
            place = place.parent
        return f"the disk at {place}, {shutil.disk_usage(place).free:,} bytes free"
    except OSError as error:
        return f"the disk at {place}, whose free space is unknown ({error.strerror})"


def explained(error: OSError) -> str:
    """Returns which file an error is about, what is wrong, and the way out; for a disk also which one."""
    if error.filename is None:
        return f"{error.strerror or error}."
    reason = REASONS.get(error.errno or 0, f"{error.strerror or error}.")
    return f"{error.filename}: {reason.format(disk=disk_of(Path(str(error.filename))))}"
