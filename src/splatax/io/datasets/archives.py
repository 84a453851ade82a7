"""Unpacks captures in zip files to temporary folders, which are removed when the process ends."""

import shutil
import stat
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from splatax.errors import DatasetError, shown
from splatax.io.damage import blamed_on
from splatax.io.datasets import names

LARGEST = 32 << 30  # bytes of all files together
MOST_FILES = 200_000
MOST_EXPANSION = 100  # times the archive's size; photos hardly compress
SMALLEST_LIMIT = 64 << 20  # bytes that any archive may unpack to
CHUNK = 1 << 20  # bytes
LITTER = {"__MACOSX", ".DS_Store", "Thumbs.db"}

_unpacked: dict[tuple[Path, int, int], tempfile.TemporaryDirectory[str]] = {}  # removed at exit


def unpacked(path: Path) -> Path:
    """Returns the folder of an archive's capture. Each archive is unpacked once per process.

    Raises:
        DatasetError: if the file is not a zip file, is damaged or encrypted, would write outside its folder,
            or is larger than any capture.
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
    """Returns the outermost folder that holds more than a single folder."""
    while len(inside := list(folder.iterdir())) == 1 and inside[0].is_dir():
        folder = inside[0]
    return folder


def unpack(path: Path, folder: Path) -> None:
    """Writes the files of an archive inside a folder, and no more bytes than its allowance.

    Raises:
        DatasetError: in the cases that `unpacked` lists.
    """
    folder.mkdir()
    left = limit = allowance(path, folder)
    with (
        blamed_on(path, "not a zip file that can be unpacked", "Make it again.", DatasetError),
        zipfile.ZipFile(path) as archive,
    ):
        for name, entry in checked(path, archive, limit).items():
            target = folder / name
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                sink = target.open("xb")
            except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
                raise DatasetError(f"{path}: two of its files have one name ({shown(name)}).") from error
            with sink, archive.open(entry) as source:
                # Bytes are counted as they arrive, because the sizes in an archive's directory may be wrong.
                while chunk := source.read(CHUNK):
                    left -= len(chunk)
                    if left < 0:
                        raise too_large(path, limit)
                    sink.write(chunk)


def allowance(path: Path, folder: Path) -> int:
    """Returns the bytes that an archive may unpack to: a plausible number, at most half of the free disk."""
    plausible = max(MOST_EXPANSION * path.stat().st_size, SMALLEST_LIMIT)
    return min(LARGEST, plausible, shutil.disk_usage(folder).free // 2)


def checked(path: Path, archive: zipfile.ZipFile, limit: int) -> dict[str, zipfile.ZipInfo]:
    """Returns the files to unpack, by the names under which they are written.

    Raises:
        DatasetError: if a file would be written elsewhere, is a link or has the name of another file, or if
            there are too many files.
    """
    files: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        if entry.is_dir() or LITTER.intersection(PurePosixPath(entry.filename).parts):
            continue
        name = names.checked(entry.filename, path)
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise DatasetError(f"{path}: {shown(name)} is a link. Zip the files themselves.")
        if name in files:
            raise DatasetError(f"{path}: two of its files have one name ({shown(name)}). Make it again.")
        files[name] = entry
    if len(files) > MOST_FILES or sum(entry.file_size for entry in files.values()) > limit:
        raise too_large(path, limit)
    return files


def too_large(path: Path, limit: int) -> DatasetError:
    """Returns the error about an archive that would fill the disk."""
    return DatasetError(
        f"{path}: it unpacks to more than {limit / 1e9:.1f} GB or {MOST_FILES:,} files, too much for the "
        "disk or for an archive of its size. If that is right, unpack it yourself and give the folder."
    )
