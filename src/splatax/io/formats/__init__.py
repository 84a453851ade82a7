"""Splat files <-> `Gaussians`, by suffix.

A format is a module with `load(path)`, `save(path, gaussians, comments=)`, or both, and

    comments(path)   the lines kept with the scene (beside `load`)
    MAX_SH_DEGREE    that it can hold (beside `save`)
    LOSES            what saving loses, one sentence (beside `save`)
    TOLERANCE        how much of each number, if it has both

`tests/contracts/test_formats.py` holds each format to them.
"""

import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.formats import compressed_ply, glb, ksplat, ply, sog, sog_folder, splat, spz
from splatax.io.formats.marks import MIP as MIP
from splatax.io.formats.marks import mark as mark

FORMATS: dict[str, ModuleType] = {
    ".ply": ply,
    ".compressed.ply": compressed_ply,
    ".splat": splat,
    ".spz": spz,
    ".sog": sog,
    "meta.json": sog_folder,
    ".glb": glb,
    ".ksplat": ksplat,
}


def load(path: str | Path) -> Gaussians:
    """Reads a splat file.

    Raises:
        FormatError: if it is missing, of no known format, or not what its suffix says.
    """
    return _readable(Path(path)).load(Path(path))


def comments(path: str | Path) -> tuple[str, ...]:
    """The lines that are kept with a scene, such as `MIP`.

    Raises:
        FormatError: as `load`.
    """
    return _readable(Path(path)).comments(Path(path))


def save(path: str | Path, gaussians: Gaussians, *, comments: tuple[str, ...] = (), **options: Any) -> None:
    """Writes a splat file, whole or not at all: a crash leaves the old file as it was.

    Empty slots are left out. So are Gaussians that are not finite, with a warning that counts them.

    Args:
        path: the suffix tells the format.
        gaussians: the scene.
        comments: lines to keep with it, where the format can; `MIP` is kept by all that have a
            place for it.
        options: of the format itself, such as `version=4` of .spz.

    Raises:
        FormatError: if no format has this suffix, or it cannot hold the scene.
    """
    path = Path(path)
    module = format_of(path)
    if not hasattr(module, "save"):
        raise FormatError(
            f"{path}: this format can only be read: splatax writes {', '.join(suffixes('save'))}."
        )
    if gaussians.sh_degree > module.MAX_SH_DEGREE:
        raise FormatError(
            f"{path}: this format holds SH up to degree {module.MAX_SH_DEGREE}, and the scene has degree "
            f"{gaussians.sh_degree}. Reduce it (--sh-degree {module.MAX_SH_DEGREE}), or choose .ply or .spz."
        )
    module.save(path, _written(path, gaussians), comments=comments, **options)


def format_of(path: Path) -> ModuleType:
    """The module for a file's suffix, the longest that fits.

    Raises:
        FormatError: if none does.
    """
    fitting = [suffix for suffix in FORMATS if path.name.lower().endswith(suffix)]
    if not fitting:
        raise FormatError(
            f"{path}: unknown format {path.suffix!r}: splatax reads {', '.join(suffixes('load'))} "
            f"and writes {', '.join(suffixes('save'))}."
        )
    return FORMATS[max(fitting, key=len)]


def suffixes(ability: str) -> list[str]:
    """Of the formats that have a function of this name."""
    return [suffix for suffix, module in FORMATS.items() if hasattr(module, ability)]


def _readable(path: Path) -> ModuleType:
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a splat file, such as the scene.ply of a run.")
    module = format_of(path)
    if not hasattr(module, "load"):
        raise FormatError(f"{path}: this format can only be written. Give the file that it was made from.")
    return module


def _written(path: Path, gaussians: Gaussians) -> Gaussians:
    """Those to write, as NumPy sees them. A scale of zero (-inf) is flat, not broken: readers know it."""
    log_scales = np.asarray(gaussians.log_scales)
    finite = np.all(np.isfinite(log_scales) | np.isneginf(log_scales), axis=1)
    for leaf in (gaussians.means, gaussians.quats, gaussians.opacity_logits, gaussians.sh):
        finite &= np.isfinite(np.asarray(leaf).reshape(len(gaussians), -1)).all(axis=1)
    empty = np.isneginf(np.asarray(gaussians.opacity_logits))
    if broken := int(np.sum(~finite & ~empty)):
        warnings.warn(f"{path}: left out {broken:,} Gaussians that are not finite", stacklevel=3)
    keep = finite & ~empty
    return gaussians if keep.all() else jax.tree.map(lambda leaf: leaf[keep], gaussians)
