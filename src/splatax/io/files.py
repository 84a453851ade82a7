"""Files that are written whole or not at all."""

import os
from pathlib import Path


def write_whole(path: Path, contents: bytes) -> None:
    """Replaces a file in one moment: a crash or a full disk leaves the old one as it was."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(contents)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
