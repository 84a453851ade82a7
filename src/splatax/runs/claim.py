"""The output folder of a command, held by one process at a time."""

import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from splatax.errors import InputError
from splatax.io.files import disk_of, explained
from splatax.runs.checkpoints import files

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
    import msvcrt

LOCK = ".splatax.lock"  # in the folder while a process writes to it; holds the process id
REPORT = 5_000_000  # bytes of the report and the pictures of a run, about
GAUSSIAN = 248 + 720  # bytes in scene.ply and in a checkpoint, with SH degree 3
AT = 1 << 30  # the byte that Windows locks, far behind the process id, which others may read


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Makes a folder, and keeps other processes from writing to it meanwhile.

    The operating system releases the lock when the process ends, even if it is killed, so a file that a
    killed process left behind blocks no other process.

    Raises:
        InputError: if another process holds the folder, or it cannot be written to.
    """
    new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _locked(folder)
    except (NotADirectoryError, FileExistsError) as error:
        raise InputError(explained(error), options=("out",)) from error
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written to ({error.strerror}; {disk_of(folder)}). Choose another folder.",
            options=("out",),
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):  # a disk error here does not undo what was done
            if fcntl:
                (folder / LOCK).unlink()  # while it is locked, else it could be the next process's
            file.close()
            if not fcntl:
                (folder / LOCK).unlink()  # Windows removes no open file, so never the next process's
        with suppress(OSError):
            if new:
                folder.rmdir()  # if nothing was written


def require_space(folder: Path, gaussians: int) -> None:
    """Checks that a disk has room for the results of a run, which would otherwise be lost after hours.

    The last state of a run is saved before the scene and the report are written.

    Args:
        folder: of the run.
        gaussians: their number at the end.

    Raises:
        InputError: if less is free than a checkpoint, a scene and a report take.
    """
    wanted = REPORT + GAUSSIAN * gaussians
    if shutil.disk_usage(folder).free < wanted:
        raise InputError(
            f"{folder}: the results need about {wanted:,} bytes ({disk_of(folder)}). Free some space, or "
            "choose another folder.",
            options=("out",),
        )


@contextmanager
def claimed_for_run(out: Path, replace: bool) -> Iterator[None]:
    """Makes the folder of a run, and keeps other processes from writing to it meanwhile.

    Args:
        out: the folder.
        replace: whether what an earlier run has written there may be replaced.

    Raises:
        InputError: if the folder holds a run that must not be replaced, another process writes to it, or it
            cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: a file, not a folder. Choose another folder.", options=("out",))
    with claimed(out):
        if files(out) and not replace:
            raise InputError(
                f"{out}: holds a run that was stopped. Resume it, choose another folder, or replace it.",
                options=(f"resume {out}", "out", "overwrite"),
            )
        if (out / "scene.ply").exists() and not replace:
            raise InputError(
                f"{out}: holds the results of a run. Choose another folder, or replace them.",
                options=("out", "overwrite"),
            )
        yield


def _locked(folder: Path) -> BinaryIO:
    path = folder / LOCK
    while True:
        file = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0)  # noqa: SIM115
        try:
            if not _lock(path, file):
                raise InputError(
                    f"{folder}: process {_holder(file)} is writing to this folder. Wait until it has ended, "
                    "or choose another folder.",
                    options=("out",),
                )
            if _still_at(path, file):
                file.truncate(0)
                file.write(str(os.getpid()).encode())
                return file
        except BaseException:
            file.close()
            raise
        file.close()  # the process before has removed the file between the opening and the locking


def _lock(path: Path, file: BinaryIO) -> bool:
    """Locks a file unless another process has. Warns where the file system has no locks."""
    try:
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            file.seek(AT)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            file.seek(0)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        warnings.warn(
            f"{path}: this file system cannot lock files ({error.strerror}). Let no two commands write "
            "to one folder.",
            stacklevel=1,
        )
    return True


def _holder(file: BinaryIO) -> str:
    """Returns the process id in a lock file."""
    file.seek(0)
    text = file.read(20).decode("ascii", "replace")
    return text if text.isdigit() else "of unknown id"


def _still_at(path: Path, file: BinaryIO) -> bool:
    """Returns whether an open file is the one that others find at the path."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
