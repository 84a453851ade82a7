"""Captures in a zip file: unpacked into a temporary folder that lasts as long as the process."""

import shutil
import stat
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from splatax.errors import DatasetError

LARGEST = 32 << 30  # bytes, of all files together
MOST_FILES = 200_000
MOST_EXPANSION = 100  # times the archive's own size; photos hardly shrink
SMALLEST_LIMIT = 64 << 20  # bytes that an archive may always grow to
CHUNK = 1 << 20  # bytes
LITTER = {"__MACOSX", ".DS_Store", "Thumbs.db"}

_unpacked: dict[tuple[Path, int, int], tempfile.TemporaryDirectory[str]] = {}  # removed at exit


def unpacked(path: Path) -> Path:
    """The folder of an archive's capture, unpacked once a process.

    Raises:
        DatasetError: if it is no zip file, is damaged or encrypted, would write outside its folder, or
            is larger than any capture.
    """
    status = path.stat()
    key = (path.resolve(), status.st_size, status.st_mtime_ns)
    if key not in _unpacked:
        folder = tempfile.TemporaryDirectory(prefix="splatax-")
        try:
            unpack(path, Path(folder.name) / path.stem)
        except BaseException:
            folder.cleanup()
            raise
        _unpacked[key] = folder
    return innermost(Path(_unpacked[key].name) / path.stem)


def innermost(folder: Path) -> Path:
    """Past folders that hold one folder and nothing else."""
    while len(inside := list(folder.iterdir())) == 1 and inside[0].is_dir():
        folder = inside[0]
    return folder


def unpack(path: Path, folder: Path) -> None:
    """Writes the files of an archive, none of which may leave the folder, and no more than is allowed."""
    folder.mkdir()
    left = limit = allowance(path, folder)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = checked(path, archive, limit)
            for entry in entries:
                target = folder / PurePosixPath(entry.filename)
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, target.open("xb") as sink:
                    # Counted as they come: the sizes that an archive announces may be lies.
                    while chunk := source.read(CHUNK):
                        left -= len(chunk)
                        if left < 0:
                            raise too_large(path, limit)
                        sink.write(chunk)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, zlib.error) as error:
        raise DatasetError(
            f"{path}: not a zip file that can be unpacked ({error}). Make it again."
        ) from error
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise DatasetError(f"{path}: two of its files have one name ({error.filename}).") from error


def allowance(path: Path, folder: Path) -> int:
    """Bytes that the archive may unpack to: what is plausible, and leaves half of the free disk."""
    plausible = max(MOST_EXPANSION * path.stat().st_size, SMALLEST_LIMIT)
    return min(LARGEST, plausible, shutil.disk_usage(folder).free // 2)


def checked(path: Path, archive: zipfile.ZipFile, limit: int) -> list[zipfile.ZipInfo]:
    """The files to unpack."""
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    entries = [entry for entry in entries if not LITTER.intersection(PurePosixPath(entry.filename).parts)]
    for entry in entries:
        name = PurePosixPath(entry.filename.replace("\\", "/"))
        if name.is_absolute() or ".." in name.parts or ":" in entry.filename or "\\" in entry.filename:
            raise DatasetError(
                f"{path}: {entry.filename!r} would be written outside its folder: not unpacked."
            )
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise DatasetError(f"{path}: {entry.filename!r} is a link. Zip the files themselves.")
    if len(entries) > MOST_FILES or sum(entry.file_size for entry in entries) > limit:
        raise too_large(path, limit)
    return entries


def too_large(path: Path, limit: int) -> DatasetError:
    return DatasetError(
        f"{path}: it unpacks to more than {limit / 1e9:.1f} GB or {MOST_FILES:,} files, too much for the "
        "disk or for what it is. If that is right, unpack it yourself and give the folder."
    )
