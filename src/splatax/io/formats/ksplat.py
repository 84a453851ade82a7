"""mkkellogg's .ksplat, the format of a three.js viewer that is no longer developed. It can only be read.

The file has a header of 4096 bytes, a header of 1024 bytes for each section, then the sections. A section
holds the sizes of the buckets that are not full, the centres of all buckets, and a row for each Gaussian.

    level 0   float32 position, linear scale, rotation (w, x, y, z); RGBA8; float32 SH
    level 1   uint16 position within the bucket, float16 scale, rotation; RGBA8; float16 SH
    level 2   like level 1, with 8-bit SH

    SH is stored band by band; within a band all of red, then of green, then of blue. SplatBuffer.js of
    GaussianSplats3D, version 0.1, defines the layout.
"""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.formats import packing
from splatax.io.formats.untrusted import Cursor
from splatax.math import harmonics

HEADER, SECTION = 4096, 1024  # bytes
MAX_SECTIONS = 1 << 16
TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))  # position, shape, SH
SH_RANGE = (-1.5, 1.5)  # range of 8-bit SH if the header has zeros
POSITION_LEVELS = 32767  # levels to each side of a bucket's centre, if a section's header has zero
MAX_DEGREE = 3


@dataclass(frozen=True)
class Section:
    """Numbers of a section's header."""

    count: int
    capacity: int  # rows that the section has space for
    bucket_size: int
    buckets: int
    block: float  # side of a bucket, world units
    bucket_bytes: int
    position_levels: int
    full: int
    partial: int
    degree: int

    @classmethod
    def parse(cls, header: np.ndarray) -> "Section":
        """Reads a section's header from its 1024 bytes."""
        words, shorts = header.view("<u4"), header.view("<u2")
        block = float(header.view("<f4")[4])
        levels = int(words[6]) or POSITION_LEVELS
        count, capacity, bucket_size, buckets = (int(word) for word in words[:4])
        full, partial, degree = int(words[8]), int(words[9]), int(shorts[20])
        return cls(
            count, capacity, bucket_size, buckets, block, int(shorts[10]), levels, full, partial, degree
        )


def load(path: Path) -> Gaussians:
    """Reads all sections.

    Raises:
        FormatError: if the file is not a .ksplat file, or is damaged.
    """
    cursor = Cursor(path, path.read_bytes())
    header = cursor.take("header", "u1", HEADER)
    sections, level = int(header.view("<u4")[1]), int(header.view("<u2")[10])
    if header[0] != 0 or header[1] < 1 or level >= len(TYPES) or sections > MAX_SECTIONS:
        raise FormatError(
            f"{path}: not a .ksplat file of version 0.1 or newer. Get the .ply that it was made from."
        )
    low, high = (float(v) for v in header.view("<f4")[9:11])
    sh_range = (low or SH_RANGE[0], high or SH_RANGE[1])
    headers = [Section.parse(cursor.take("section headers", "u1", SECTION)) for _ in range(sections)]
    for section in headers:
        if section.degree > MAX_DEGREE or section.count > section.capacity:
            raise FormatError(
                f"{path}: damaged: a section of {section.count:,} Gaussians, degree {section.degree}."
            )
    degree = max((section.degree for section in headers if section.count), default=0)
    parts = [_section(cursor, section, level, sh_range, degree) for section in headers]
    total = int(header.view("<u4")[4])
    if sum(section.count for section in headers) != total or total == 0:
        raise FormatError(f"{path}: damaged: its sections do not hold the {total:,} Gaussians it claims.")
    return Gaussians(*(jnp.asarray(np.concatenate(fields)) for fields in zip(*parts, strict=True)))


def comments(path: Path) -> tuple[str, ...]:
    """Returns no comments, because the format cannot hold any."""
    return ()


def _section(cursor: Cursor, section: Section, level: int, sh_range: tuple[float, float], degree: int):
    position, shape, harmonic = TYPES[level]
    rest = harmonics.count(section.degree) - 1
    row = np.dtype(
        [
            ("mean", position, 3),
            ("scale", shape, 3),
            ("quat", shape, 4),
            ("rgba", "u1", 4),
            ("sh", harmonic, 3 * rest),
        ]
    )
    sizes = cursor.take("bucket sizes", "<u4", section.partial)
    buckets = cursor.take("buckets", "u1", section.buckets, section.bucket_bytes)
    body = cursor.take("Gaussians", "u1", section.capacity, row.itemsize)
    rows = np.ascontiguousarray(body[: section.count]).view(row).reshape(section.count)

    means: np.ndarray = rows["mean"].astype(np.float32)
    if level > 0 and section.count:
        if section.bucket_bytes < 12:
            raise FormatError(f"{cursor.path}: damaged: buckets of {section.bucket_bytes} bytes.")
        centres = np.ascontiguousarray(buckets[:, :12]).view("<f4")
        step = np.float32(section.block / 2 / section.position_levels)
        means = (means - section.position_levels) * step + centres[_bucket_of(cursor.path, section, sizes)]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scale"].astype(np.float32))
    dc = harmonics.from_rgb(rows["rgba"][:, :3].astype(np.float32) / 255)[:, None]
    higher: np.ndarray = rows["sh"].astype(np.float32).reshape(section.count, 3 * rest)
    if level == 2:
        higher = np.float32(sh_range[0]) + higher / 255 * np.float32(sh_range[1] - sh_range[0])
    sh = np.zeros((section.count, harmonics.count(degree), 3), np.float32)
    sh[:, :1] = dc
    for band in range(1, min(section.degree, degree) + 1):  # an empty section may have another degree
        first, last = band**2, (band + 1) ** 2
        channels = higher[:, 3 * (first - 1) : 3 * (last - 1)].reshape(section.count, 3, last - first)
        sh[:, first:last] = channels.transpose(0, 2, 1)
    logits = packing.opacity_logits(rows["rgba"][:, 3])
    return means.astype(np.float32), rows["quat"].astype(np.float32), log_scales, logits, sh


def _bucket_of(path: Path, section: Section, partial_sizes: np.ndarray) -> np.ndarray:
    """Returns the index of each Gaussian's bucket. Full buckets come first, then those with a given size."""
    full = section.full * section.bucket_size
    ends = full + np.cumsum(partial_sizes, dtype=np.int64)
    rows = np.arange(section.count)
    of_partial = section.full + np.searchsorted(ends, rows, side="right")
    buckets = np.where(rows < full, rows // max(section.bucket_size, 1), of_partial)
    if buckets.max(initial=0) >= section.buckets:
        raise FormatError(f"{path}: damaged: Gaussians in buckets that are not there.")
    return buckets
