"""PlayCanvas' streamed SOG: levels of detail in cells of space, which a viewer loads as it needs them.

    lod-meta.json      a binary tree of boxes; a leaf names, for each level, rows of a unit
    LEVEL_UNIT-HASH/   a unit: an unzipped SOG scene (see sog.py) with the rows of some leaves of one level

Level 0 is the scene, and higher levels have fewer Gaussians. Units are named after their contents and written
first, lod-meta.json last, so that a crash leaves the scene that was there before.
(github.com/playcanvas/splat-transform; playcanvas.com: streamed SOG)
"""

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.files import write_whole
from splatax.io.formats import sog
from splatax.math import morton

META = "lod-meta.json"
MAX_META = 64 << 20  # bytes
UNIT = 512 * 1024  # Gaussians in a leaf or a unit at most, about
DEEPEST = 64  # nodes above a leaf
OURS = re.compile(r"\d+_\d+-[0-9a-f]{8}/meta\.json")
SIGMAS = 3.0  # standard deviations inside a box

MAX_SH_DEGREE, KEPT_MARKS, TOLERANCE = sog.MAX_SH_DEGREE, sog.KEPT_MARKS, sog.TOLERANCE
LOSES = sog.LOSES


@dataclass
class Cells:
    """Cells that are being written: what the leaves hold, unit by unit.

    Attributes:
        means: centres of the Gaussians of each level.
        reaches: half the sides of their boxes.
        units: for each level, lists of rows; the last one is filled next.
    """

    means: Sequence[Float[np.ndarray, "_ 3"]]
    reaches: Sequence[Float[np.ndarray, "_ 3"]]
    units: list[list[list[Int[np.ndarray, "_"]]]]

    def node(self, rows: Sequence[Int[np.ndarray, "_"]]) -> dict[str, Any]:
        """Divides Gaussians until few are in each cell; returns the node of the tree above them.

        Args:
            rows: of each level.
        """
        places = np.concatenate([means[of] for means, of in zip(self.means, rows, strict=True)])
        if len(places) <= UNIT:
            return self._leaf(rows)
        axis = int(np.argmax(np.ptp(places, axis=0)))
        middle = np.median(places[:, axis])
        below = [means[of, axis] < middle for means, of in zip(self.means, rows, strict=True)]
        if not 0 < sum(np.count_nonzero(side) for side in below) < len(places):
            return self._leaf(rows)  # all at one place
        children = [
            self.node([of[side] for of, side in zip(rows, below, strict=True)]),
            self.node([of[~side] for of, side in zip(rows, below, strict=True)]),
        ]
        low = np.minimum(*(child["bound"]["min"] for child in children))
        high = np.maximum(*(child["bound"]["max"] for child in children))
        return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}

    def _leaf(self, rows: Sequence[Int[np.ndarray, "_"]]) -> dict[str, Any]:
        lods, low, high = {}, np.full(3, np.inf), np.full(3, -np.inf)
        for level, of in enumerate(rows):
            if len(of) == 0:
                continue
            means, reach = self.means[level][of], self.reaches[level][of]
            low, high = (
                np.minimum(low, (means - reach).min(axis=0)),
                np.maximum(high, (means + reach).max(axis=0)),
            )
            units = self.units[level]
            taken = sum(map(len, units[-1]))
            if taken and taken + len(of) > UNIT:
                units.append([])
                taken = 0
            lods[str(level)] = {"file": (level, len(units) - 1), "offset": taken, "count": len(of)}
            units[-1].append(of[morton.order(means)])
        return {"bound": {"min": low.tolist(), "max": high.tolist()}, "lods": lods}


def save(
    path: Path,
    gaussians: Gaussians,
    *,
    comments: tuple[str, ...] = (),
    coarser: Sequence[Gaussians] = (),
) -> None:
    """Writes lod-meta.json, and units in folders beside it. Units of an earlier scene are removed.

    Args:
        path: of the file, whose name ends with lod-meta.json.
        gaussians: the scene.
        comments: lines to keep with it.
        coarser: its further levels of detail, such as `splatax.editing.levels_of` makes.

    Raises:
        FormatError: if a level is empty.
    """
    levels = (gaussians, *coarser)
    if not all(map(len, levels)):
        raise FormatError(f"{path}: each level of detail needs at least one Gaussian.")
    means, reaches = zip(*map(_boxes, levels), strict=True)
    cells = Cells(means, reaches, [[[]] for _ in levels])
    tree = cells.node([np.arange(len(level)) for level in levels])
    old = _units_of(path)
    with _written(path.parent) as write:
        new = {
            (level, index): write(f"{level}_{index}", sog.files_of(_rows(levels[level], parts), comments))
            for level, units in enumerate(cells.units)
            for index, parts in enumerate(units)
        }
        filenames = list(new.values())
        for _, reference in _references(path, tree):
            reference["file"] = filenames.index(new[reference["file"]])
        counts = [len(level) for level in levels]
        meta = {
            "version": 1,
            "asset": {"generator": "splatax"},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(levels),
            "filenames": filenames,
            "tree": tree,
        }
        write_whole(path, json.dumps(meta).encode())
    for name in set(old) - set(filenames):
        shutil.rmtree((path.parent / name).parent)


@contextmanager
def _written(folder: Path) -> Iterator[Callable[[str, dict[str, bytes]], str]]:
    """Gives a function that writes a unit and returns its name; removes new units if the rest fails."""
    new: list[Path] = []

    def write(name: str, files: dict[str, bytes]) -> str:
        digest = hashlib.sha256(b"".join(files.values())).hexdigest()[:8]
        unit = folder / f"{name}-{digest}"
        if not unit.exists():
            new.append(unit)
        unit.mkdir(parents=True, exist_ok=True)
        for file, contents in files.items():
            write_whole(unit / file, contents)
        return f"{unit.name}/{sog.META}"

    try:
        yield write
    except BaseException:
        for unit in new:
            shutil.rmtree(unit)
        raise


def _rows(gaussians: Gaussians, parts: Sequence[Int[np.ndarray, "_"]]) -> Gaussians:
    rows = np.concatenate(parts)
    return jax.tree.map(lambda leaf: leaf[rows], gaussians)


def load(path: Path) -> Gaussians:
    """Reads level 0: the whole scene.

    Raises:
        FormatError: if the file or a unit is damaged.
    """
    units = [sog.load(unit) for unit in _finest(path)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *units)


def comments(path: Path) -> tuple[str, ...]:
    """Returns the comment lines of the units of level 0."""
    return tuple(dict.fromkeys(line for unit in _finest(path) for line in sog.comments(unit)))


def _boxes(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Returns centres, and half the sides of boxes around the Gaussians."""
    variances = np.diagonal(np.asarray(gaussians.covariances, np.float64), axis1=1, axis2=2)
    return np.asarray(gaussians.means, np.float64), SIGMAS * np.sqrt(variances)


def _meta(path: Path) -> dict[str, Any]:
    if path.stat().st_size > MAX_META:
        raise FormatError(f"{path}: damaged: larger than {MAX_META:,} bytes.")
    meta = json.loads(path.read_bytes())
    if meta.get("version", 1) != 1:
        raise FormatError(f"{path}: streamed SOG of version {meta['version']}: splatax reads 1.")
    return meta


def _finest(path: Path) -> list[Path]:
    """Returns the units of level 0, and that of an environment, which belongs to every level."""
    meta = _meta(path)
    files = {reference["file"] for level, reference in _references(path, meta["tree"]) if level == "0"}
    names = [meta["filenames"][file] for file in sorted(files)]
    if "environment" in meta:
        names.append(meta["environment"])
    if not names:
        raise FormatError(f"{path}: damaged: it names no Gaussians of level 0.")
    for name in names:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise FormatError(f"{path}: names a file outside its folder, {name!r}.")
        if not (path.parent / name).is_file():
            raise FormatError(f"{path}: {name} is missing. Copy the whole folder.")
    return [path.parent / name for name in names]


def _references(path: Path, node: dict[str, Any], depth: int = 0) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields level and reference of all leaves."""
    if depth > DEEPEST:
        raise FormatError(f"{path}: damaged: its tree has more than {DEEPEST} levels.")
    yield from node.get("lods", {}).items()
    for child in node.get("children", ()):
        yield from _references(path, child, depth + 1)


def units(path: Path) -> list[Path]:
    """Returns the folders of the units of all levels that splatax wrote."""
    return [(path.parent / name).parent for name in _units_of(path)]


def _units_of(path: Path) -> list[str]:
    """Returns the names of the units of the scene at a path, if splatax wrote one there."""
    try:
        names = _meta(path)["filenames"]
    except (FileNotFoundError, ValueError, KeyError, FormatError):
        return []  # nothing that could be read
    return [name for name in names if OURS.fullmatch(str(name))]
