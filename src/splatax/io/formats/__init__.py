"""Splat files <-> `Gaussians`, by suffix. A format is a module with `load` and `save`."""

from pathlib import Path

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.formats import ply

FORMATS = {".ply": ply}


def load(path: str | Path) -> Gaussians:
    """Reads a splat file.

    Raises:
        FormatError: if it is missing, of no known format, or not what its suffix says.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a splat file, such as the scene.ply of a run.")
    return format_of(path).load(path)


def save(path: str | Path, gaussians: Gaussians, *, comments: tuple[str, ...] = ()) -> None:
    """Writes a splat file, whole or not at all: a crash leaves the old file as it was.

    Empty slots are left out. So are Gaussians that are not finite, with a warning that counts them.

    Args:
        path: the suffix tells the format.
        gaussians: the scene.
        comments: lines to keep with it, where the format can.

    Raises:
        FormatError: if no format has this suffix.
    """
    path = Path(path)
    format_of(path).save(path, gaussians, comments=comments)


def format_of(path: Path):
    """The module for a file's suffix."""
    module = FORMATS.get(path.suffix.lower())
    if module is None:
        raise FormatError(
            f"{path}: unknown format {path.suffix!r}: splatax reads and writes {', '.join(FORMATS)}."
        )
    return module
