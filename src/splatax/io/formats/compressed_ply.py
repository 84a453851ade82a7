"""SuperSplat's compressed PLY: chunks of 256 splats share the ranges of their packed numbers.

chunk    min/max of x y z, of the log scales, and (newer files) of the colour
vertex   packed_position 11-10-11 bits, packed_rotation 2+3x10, packed_scale 11-10-11,
         packed_color 8-8-8-8 (RGB from DC, and opacity)
sh       f_rest as 8 bits, channel-major as in INRIA's .ply

PlayCanvas' splat-transform and engine use the same layout.
"""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.formats import packing, ply_table
from splatax.io.formats.marks import MARKS
from splatax.io.formats.ply_table import PlyTable
from splatax.io.formats.tolerance import Tolerance
from splatax.math import harmonics, morton

CHUNK = 256
AXES = ("min_{}", "max_{}")
POSITION, SCALE, COLOR = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
SH_RANGE = 8.0  # 8-bit coefficients range from -4 to 4
LARGEST_LOG_SCALE = 20.0  # clipped: a few absurd ones would stretch the range of their chunk

MAX_SH_DEGREE = 3
LOSES = (
    "positions, scales and colours are rounded to 8 to 11 bits within each chunk of 256, "
    "higher SH to steps of 1/32 within -4 to 4; the order changes."
)
KEPT_MARKS = MARKS
TOLERANCE = Tolerance(means=1e-3, degrees=0.28, log_scales=3e-3, opacities=3e-3, dc=0.02, sh=0.04)


def load(path: Path) -> Gaussians:
    """Reads a compressed PLY.

    Raises:
        FormatError: if the file is not a compressed PLY, or is damaged.
    """
    table = ply_table.read(path)
    if "chunk" not in table.elements:
        raise FormatError(f"{path}: a PLY file, but not a compressed one. Rename it to end in .ply alone.")
    return decode(path, table)


def comments(path: Path) -> tuple[str, ...]:
    """Returns the comments in the header."""
    return ply_table.read(path).comments


def save(path: Path, gaussians: Gaussians, *, comments: tuple[str, ...] = ()) -> None:
    """Writes Gaussians in Morton order, with their spherical harmonics up to degree 3."""
    order = morton.order(np.asarray(gaussians.means))
    chunks, names = [], []
    packed = np.empty((len(order), len(PACKED)), "<u4")
    log_scales = packing.finite_log_scales(np.asarray(gaussians.log_scales))
    for columns, fields, values in (
        (0, POSITION, np.asarray(gaussians.means)),
        (2, SCALE, np.minimum(log_scales, np.float32(LARGEST_LOG_SCALE))),
        (3, COLOR, harmonics.to_rgb(np.asarray(gaussians.sh[:, 0]))),
    ):
        low, high, fractions = _ranges(values[order])
        chunks += [low, high]
        names += [name.format(axis) for name in AXES for axis in fields]
        if fields is COLOR:
            opacity = packing.opacity_levels(np.asarray(gaussians.opacity_logits)[order])
            rgba = np.concatenate([packing.levels(fractions, 255), opacity[:, None]], axis=1)
            packed[:, columns] = packing.pack(rgba, 8, 8, 8, 8)
        else:
            tops = np.array([2047, 1023, 2047], np.float32)
            packed[:, columns] = packing.pack(np.rint(fractions * tops), 11, 10, 11)
    largest, others = packing.smallest_three(packing.unit(np.asarray(gaussians.quats)[order]))
    tens = packing.levels(others / np.float32(math.sqrt(2)) + np.float32(0.5), 1023)
    packed[:, 1] = packing.pack(np.concatenate([largest[:, None], tens], axis=1), 2, 10, 10, 10)

    elements = {
        "chunk": _rows(np.concatenate(chunks, axis=1).astype("<f4"), names),
        "vertex": _rows(packed, PACKED),
    }
    rest = np.asarray(gaussians.sh[:, 1:])[order]
    if rest.any():  # no level is exactly zero, and +-1/64 in all of them would tint the scene
        levels = _sh_levels(rest)
        elements["sh"] = _rows(levels, [f"f_rest_{i}" for i in range(levels.shape[1])])
    ply_table.write(path, elements, comments)


def decode(path: Path, table: PlyTable) -> Gaussians:
    """Returns the Gaussians of a table that has chunks.

    Raises:
        FormatError: if parts are missing or do not fit together.
    """
    chunks, vertex = table.elements["chunk"], table.elements.get("vertex")
    if vertex is None or not _has(vertex, PACKED, "u4") or not _has(chunks, _range_names(POSITION + SCALE)):
        raise FormatError(
            f"{path}: has chunks but no packed splats: not a compressed PLY that splatax knows."
        )
    if len(chunks) * CHUNK < len(vertex):
        raise FormatError(f"{path}: {len(chunks)} chunks of {CHUNK} are too few for {len(vertex):,} splats.")
    chunk = chunks[np.arange(len(vertex)) // CHUNK]
    words = {name: vertex[name].astype(np.uint32) for name in PACKED}

    rgba = packing.unpack(words["packed_color"], 8, 8, 8, 8)
    rgb = rgba[:, :3].astype(np.float32) / 255
    if _has(chunks, _range_names(COLOR)):
        rgb = _in_range(chunk, COLOR, rgb)
    dc = harmonics.from_rgb(rgb).astype(np.float32)
    sh = np.concatenate([dc[:, None], _higher_bands(path, table, len(vertex))], axis=1)
    rotation = packing.unpack(words["packed_rotation"], 2, 10, 10, 10)
    others = (rotation[:, 1:].astype(np.float32) / 1023 - np.float32(0.5)) * np.float32(math.sqrt(2))
    tops = np.array([2047, 1023, 2047], np.float32)
    positions, scales = (packing.unpack(words[PACKED[i]], 11, 10, 11) / tops for i in (0, 2))
    return Gaussians(
        means=jnp.asarray(_in_range(chunk, POSITION, positions)),
        quats=jnp.asarray(packing.from_smallest_three(rotation[:, 0].astype(int), others)),
        log_scales=jnp.asarray(_in_range(chunk, SCALE, scales)),
        opacity_logits=jnp.asarray(packing.opacity_logits(rgba[:, 3])),
        sh=jnp.asarray(sh),
    )


def _ranges(
    values: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "c 3"], Float[np.ndarray, "n 3"]]:
    """Returns the minimum and maximum of each chunk, and each value's position between them in [0, 1]."""
    starts = np.arange(0, len(values), CHUNK)
    if len(starts) == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), values
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    mine = np.arange(len(values)) // CHUNK
    spread = (high - low)[mine]
    fractions = (values - low[mine]) / np.where(spread > 0, spread, 1)  # all values of a chunk may be equal
    return low, high, np.clip(fractions, 0, 1).astype(np.float32)


def _rows(values: np.ndarray, names) -> np.ndarray:
    """Returns the rows of a table whose columns have one type."""
    dtype = np.dtype([(name, values.dtype) for name in names])
    return np.ascontiguousarray(values).view(dtype).reshape(len(values))


def _range_names(fields: tuple[str, ...]) -> list[str]:
    return [end.format(field) for end in AXES for field in fields]


def _has(rows: np.ndarray, names, kind: str = "f4") -> bool:
    found = set(rows.dtype.names or ())
    return all(name in found and rows.dtype[name].str[1:] == kind for name in names)


def _in_range(
    chunk: np.ndarray, fields: tuple[str, ...], fractions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    low, high = (np.stack([chunk[end.format(field)] for field in fields], 1) for end in AXES)
    return (low * (1 - fractions) + high * fractions).astype(np.float32)


def _sh_levels(rest: Float[np.ndarray, "n k 3"]) -> UInt8[np.ndarray, "n rest"]:
    fractions = rest.transpose(0, 2, 1).reshape(len(rest), -1) / np.float32(SH_RANGE) + np.float32(0.5)
    return np.clip(np.floor(fractions * 256), 0, 255).astype(np.uint8)


def _higher_bands(path: Path, table: PlyTable, count: int) -> Float[np.ndarray, "n k 3"]:
    if "sh" not in table.elements:
        return np.zeros((count, 0, 3), np.float32)
    element = table.elements["sh"]
    names = [f"f_rest_{i}" for i in range(len(element.dtype.names or ()))]
    fits = harmonics.degree_of_file(len(names)) is not None and _has(element, names, "u1")
    if len(element) != count or not fits:
        raise FormatError(
            f"{path}: {len(element):,} rows of {len(names)} SH values do not fit {count:,} splats."
        )
    levels = np.stack([element[name] for name in names], axis=1).astype(np.float32)
    fractions = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
    channels = ((fractions - 0.5) * SH_RANGE).reshape(count, 3, len(names) // 3)
    return channels.transpose(0, 2, 1).astype(np.float32)
