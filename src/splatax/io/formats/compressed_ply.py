"""SuperSplat's compressed PLY: 256 splats share the ranges that their packed numbers run in.

chunk    min/max of x y z, of the log scales, and (newer files) of the colour
vertex   packed_position 11-10-11 bits, packed_rotation 2+3x10, packed_scale 11-10-11,
         packed_color 8-8-8-8 (RGB from DC, and opacity)
sh       f_rest as 8 bits, channel-major as in INRIA's .ply
"""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.formats.ply_table import PlyTable
from splatax.math import harmonics

CHUNK = 256
PACKED = {"packed_position", "packed_rotation", "packed_scale", "packed_color"}
SH_RANGE = 8.0  # 8-bit coefficients run from -4 to 4


def decode(path: Path, table: PlyTable) -> Gaussians:
    """Unpacks a table that has chunks.

    Raises:
        FormatError: if parts are missing or do not fit together.
    """
    chunks, vertex = table.elements["chunk"], table.elements.get("vertex")
    if vertex is None or not set(vertex.dtype.names or ()) >= PACKED:
        raise FormatError(
            f"{path}: has chunks but no packed splats: not a compressed PLY that splatax knows."
        )
    if len(chunks) * CHUNK < len(vertex):
        raise FormatError(f"{path}: {len(chunks)} chunks of {CHUNK} are too few for {len(vertex):,} splats.")
    chunk = chunks[np.arange(len(vertex)) // CHUNK]

    rgba = _bits(vertex["packed_color"], 8, 8, 8, 8)
    rgb = rgba[:, :3]
    if "min_r" in (chunks.dtype.names or ()):
        rgb = _in_range(chunk, "{}_r {}_g {}_b", rgb)
    # Half a level inside the ends: a logit must stay finite.
    opacity = np.clip(rgba[:, 3], 0.5 / 255, 1 - 0.5 / 255)
    dc = np.asarray(harmonics.from_rgb(rgb), np.float32)
    sh = np.concatenate([dc[:, None], _higher_bands(path, table, len(vertex))], axis=1)
    scales = _bits(vertex["packed_scale"], 11, 10, 11)
    positions = _bits(vertex["packed_position"], 11, 10, 11)
    return Gaussians(
        means=jnp.asarray(_in_range(chunk, "{}_x {}_y {}_z", positions)),
        quats=jnp.asarray(_rotations(vertex["packed_rotation"])),
        log_scales=jnp.asarray(_in_range(chunk, "{}_scale_x {}_scale_y {}_scale_z", scales)),
        opacity_logits=jnp.asarray(np.log(opacity / (1 - opacity))),
        sh=jnp.asarray(sh),
    )


def _bits(words: np.ndarray, *widths: int) -> Float[np.ndarray, "n k"]:
    """Fields of a 32-bit word, the first in the highest bits, each as a number in [0, 1]."""
    fields, shift = [], sum(widths)
    for width in widths:
        shift -= width
        top = (1 << width) - 1
        fields.append(((words >> np.uint32(shift)) & np.uint32(top)).astype(np.float32) / np.float32(top))
    return np.stack(fields, axis=1)


def _in_range(chunk: np.ndarray, names: str, fractions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    low, high = (np.stack([chunk[n] for n in names.replace("{}", end).split()], 1) for end in ("min", "max"))
    return (low * (1 - fractions) + high * fractions).astype(np.float32)


def _rotations(words: np.ndarray) -> Float[np.ndarray, "n 4"]:
    """(w, x, y, z): the index of the largest, and the other three, which lie within +-sqrt(1/2)."""
    largest = (words >> np.uint32(30)).astype(int)
    others = (_bits(words & np.uint32((1 << 30) - 1), 10, 10, 10) - np.float32(0.5)) * np.float32(
        math.sqrt(2)
    )
    rest = np.sqrt(np.maximum(1 - np.sum(others**2, axis=1), 0))
    quats = np.empty((len(words), 4), np.float32)
    for index in range(4):
        rows = largest == index
        quats[rows] = np.insert(others[rows], index, rest[rows], axis=1)
    return quats


def _higher_bands(path: Path, table: PlyTable, count: int) -> Float[np.ndarray, "n k 3"]:
    if "sh" not in table.elements:
        return np.zeros((count, 0, 3), np.float32)
    element = table.elements["sh"]
    names = element.dtype.names or ()
    if len(element) != count or harmonics.degree_of_file(len(names)) is None:
        raise FormatError(
            f"{path}: {len(element):,} rows of {len(names)} SH values do not fit {count:,} splats."
        )
    levels = np.stack([element[f"f_rest_{i}"] for i in range(len(names))], axis=1).astype(np.float32)
    fractions = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
    return (
        ((fractions - 0.5) * SH_RANGE)
        .reshape(count, 3, len(names) // 3)
        .transpose(0, 2, 1)
        .astype(np.float32)
    )
