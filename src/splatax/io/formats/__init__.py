"""Reads and writes splat files; the suffix of the name decides the format.

A format is a module with `load(path)` and `comments(path)`, which returns the lines kept with the scene.
Those that are not in `READ_ONLY` also have

    save(path, gaussians, comments=)
    MAX_SH_DEGREE    the highest SH degree that the format can hold
    LOSES            what saving loses, as the sentence goes on after "loses: "
    KEPT_MARKS       the marks of how a scene is drawn that the file keeps
    TOLERANCE        the largest error of each number after saving and loading

    A reader may raise any exception on a damaged file; `load` and `comments` turn it into a `FormatError`.
    `tests/contracts/test_formats.py` tests each format against these rules.
"""

import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians, broken, checked, rows_of
from splatax.io.formats import (
    compressed_ply,
    glb,
    gsplat_pt,
    ksplat,
    ply,
    sog,
    sog_folder,
    sog_streamed,
    splat,
    spz,
)
from splatax.io.formats.marks import BY_DISTANCE, DISCS, MARKS, PLAIN, VARIANCE, is_mark, marked, marks_of
from splatax.io.formats.marks import MIP as MIP
from splatax.io.formats.untrusted import structured
from splatax.packages import required_by

FORMATS: dict[str, ModuleType] = {
    ".ply": ply,
    ".compressed.ply": compressed_ply,
    ".splat": splat,
    ".spz": spz,
    ".sog": sog,
    "meta.json": sog_folder,
    "lod-meta.json": sog_streamed,
    ".glb": glb,
    ".ksplat": ksplat,
    ".pt": gsplat_pt,
}
IN_WORDS = {  # by mark
    MIP: "trained with antialiasing",
    DISCS: "drawn along rays (2DGS)",
    BY_DISTANCE: "trained in the order of distances",
}
READ_ONLY = (sog_folder, ksplat, gsplat_pt)
WRITTEN = tuple(suffix for suffix, module in FORMATS.items() if module not in READ_ONLY)


def load(path: str | Path) -> Gaussians:
    """Reads a splat file. All arrays of the result have the same number of rows.

    A file that says that its scene was trained with antialiasing or in the order of distances, or is drawn
    along rays (2DGS), gives a scene that is drawn so.

    Raises:
        FormatError: if the file is missing, damaged, of an unknown format, or does not match its suffix.
    """
    path = Path(path)
    module = _readable(path)
    with structured(path, path.suffix):
        return marked(checked(module.load(path)), module.comments(path))


def comments(path: str | Path) -> tuple[str, ...]:
    """Returns the comment lines that a file keeps with its scene, such as `MIP`.

    Raises:
        FormatError: in the cases that `load` lists.
    """
    path = Path(path)
    module = _readable(path)
    with structured(path, path.suffix):
        return module.comments(path)


def save(path: str | Path, gaussians: Gaussians, *, comments: tuple[str, ...] = (), **options: Any) -> int:
    """Writes a splat file atomically: a crash leaves the old file unchanged.

    Empty slots are left out. Broken Gaussians (`splatax.gaussians.broken`) are left out too, with a warning
    that counts them.

    Args:
        path: path of the file; its suffix selects the format.
        gaussians: scene to write.
        comments: lines to keep with the scene, if the format can, beside those that say how it is drawn.
        options: options of the format, such as `version=4` for .spz.

    Returns:
        The number of Gaussians that were written.

    Raises:
        FormatError: if no format has this suffix, or the format cannot hold the scene.
    """
    path = Path(path)
    module = format_of(path)
    if module in READ_ONLY:
        raise FormatError(f"{path}: this format can only be read: splatax writes {', '.join(WRITTEN)}.")
    if gaussians.sh_degree > module.MAX_SH_DEGREE:
        raise FormatError(
            f"{path}: this format holds SH up to degree {module.MAX_SH_DEGREE}, and the scene has degree "
            f"{gaussians.sh_degree}. Reduce it to degree {module.MAX_SH_DEGREE} "
            "(splatax.editing.reduce_degree), or choose .ply or .spz.",
            options=(f"sh_degree {module.MAX_SH_DEGREE}",),
        )
    written = _written(path, gaussians)
    own = marks_of(gaussians.low_pass, gaussians.order)
    lines = (*own, *(line for line in comments if not is_mark(line)))
    with required_by(f"writing {path}"):
        module.save(path, written, comments=lines, **options)
    if lost := [_in_words(line) for line in own if line != PLAIN and not _keeps(module, line)]:
        trained = " and ".join(lost)
        warnings.warn(
            f"{path}: the format cannot store that the scene was {trained}. Renderers must be told.",
            stacklevel=2,
        )
    return len(written)


def _keeps(module: ModuleType, line: str) -> bool:
    """Returns whether a format keeps a mark. Those that keep all kinds keep all comments."""
    return line in module.KEPT_MARKS or (line not in MARKS and module.KEPT_MARKS == MARKS)


def _in_words(line: str) -> str:
    return IN_WORDS.get(line) or f"filtered with {line.removeprefix(VARIANCE)} square pixels"


def format_of(path: Path) -> ModuleType:
    """Returns the format whose suffix is the longest that matches a file's name.

    Raises:
        FormatError: if no suffix matches.
    """
    fitting = [suffix for suffix in FORMATS if path.name.lower().endswith(suffix)]
    if not fitting:
        raise FormatError(
            f"{path}: unknown format {path.suffix!r}: splatax reads {', '.join(FORMATS)} "
            f"and writes {', '.join(WRITTEN)}."
        )
    return FORMATS[max(fitting, key=len)]


def size_of(path: Path) -> int:
    """Returns the number of bytes of a splat file, with those of the units of a streamed scene."""
    units = sog_streamed.units(path) if format_of(path) is sog_streamed else []
    return sum(file.stat().st_size for file in (path, *(file for unit in units for file in unit.iterdir())))


def _readable(path: Path) -> ModuleType:
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise FormatError(f"{path}: {found}. Give a splat file, such as the scene.ply of a run.")
    return format_of(path)


def _written(path: Path, gaussians: Gaussians) -> Gaussians:
    """Returns the Gaussians to write, which are all except broken ones and empty slots."""
    wrong, empty = broken(gaussians), np.isneginf(np.asarray(gaussians.opacity_logits))
    if count := int(np.sum(wrong & ~empty)):
        warnings.warn(f"{path}: left out {count:,} Gaussians that are not finite", stacklevel=3)
    keep = ~wrong & ~empty
    return gaussians if keep.all() else rows_of(gaussians, np.flatnonzero(keep))
