"""Files that are written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write to that takes the place of another when all is written and on the disk: a crash or
    a full disk leaves the old one as it was.

    Raises:
        OSError: of this path, if it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if error.filename == str(temporary):
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):  # where it could not be written, it often cannot be removed
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, contents: bytes) -> None:
    """Replaces a file in one moment; see `replacing`."""
    with replacing(path) as file:
        file.write(contents)
