"""Niantic's .spz: each attribute in few bits, all of one kind together, then compressed.

    header     magic NGSP, version, count, SH degree, fractional bits, flags
    positions  24-bit fixed point      alphas     8 bits
    colours    8 bits of 0.15 dc + 0.5 scales     8 bits of 16 (log s + 10)
    rotations  smallest three, 2 + 3 x (sign and 9 bits), in (x, y, z, w) order
    SH         8 bits of 128 v + 128, colour fastest

Version 1 has float16 positions; 1 and 2 have rotations as 3 x 8 bits of x, y, z. Up to version 3
one gzip stream holds all, header included; version 4 has a plain header and a Zstandard stream
for each attribute. The frame is right-up-back, ours right-down-forward: half a turn around x.
(github.com/nianticlabs/spz: README.md and src/cc/load-spz.cc)
"""

import gzip
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.files import write_whole
from splatax.io.formats import packing
from splatax.io.formats.marks import MIP, PLAIN
from splatax.io.formats.tolerance import Tolerance
from splatax.io.formats.untrusted import Cursor, check_expansion, inflate
from splatax.math import harmonics
from splatax.transforms import half_turn

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")  # the last byte is the number of streams in version 4
HEADER_4 = struct.Struct("<4sIIBBBBI12x")  # adds the offset of the streams' table of contents
ANTIALIASED, EXTENDED = 1, 2  # flags
TRAILER = 1 << 16  # most bytes of extensions after the data, which are skipped
DEFAULT_FRACTIONAL_BITS = 12
COLOR_SCALE = 0.15
XYZW = [1, 2, 3, 0]  # from splatax's order of quaternion components; [3, 0, 1, 2] is the inverse
GZIP_LEVEL = 6  # 9 is 7 times slower and 3 % smaller (305,492 Gaussians of SH degree 3)
BUCKETS = (8, 16)  # levels merged into one, for SH degree 1 and for higher ones; larger compresses better

MAX_SH_DEGREE = 4
LOSES = (
    "positions are rounded to 24 bits, opacities, colours and scales to 8 bits, rotations to 10; higher SH "
    "to 5 bits (degree 1) and 4 bits, clipped to -1 to 1; log scales are clipped to -10 to 5.9."
)
KEPT_MARKS = (MIP, PLAIN)
TOLERANCE = Tolerance(means=1.1e-4, degrees=0.28, log_scales=0.032, opacities=3e-3, dc=0.014, sh=0.07)


@dataclass(frozen=True)
class Header:
    """Header of a file."""

    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    streams: int  # or reserved, before version 4
    contents: int = 0  # offset of the table of contents in version 4

    def row_sizes(self) -> tuple[int, ...]:
        """Returns the number of bytes of one Gaussian's position, alpha, colour, scales, rotation and SH."""
        rest = 3 * (harmonics.count(self.degree) - 1)
        position, rotation = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        return position, 1, 3, 3, rotation, rest

    def sizes(self) -> list[int]:
        """Returns the number of bytes of all positions, alphas, colours, scales, rotations and SH."""
        return [self.count * size for size in self.row_sizes()]


def load(path: Path) -> Gaussians:
    """Reads versions 1 to 4.

    Raises:
        FormatError: if the file is not an SPZ file, is damaged, or is truncated.
    """
    contents = path.read_bytes()
    header = _header(path, contents)
    check_expansion(path, sum(header.sizes()), len(contents))
    if header.flags & EXTENDED:
        warnings.warn(f"{path}: its extensions are not read", stacklevel=3)
    return half_turn(_decode(header, *_streams(path, contents, header)), axis=0)


def comments(path: Path) -> tuple[str, ...]:
    """Returns the mark of antialiasing, if the file has it."""
    return (MIP,) if _header(path, path.read_bytes()).flags & ANTIALIASED else ()


def save(
    path: Path,
    gaussians: Gaussians,
    *,
    comments: tuple[str, ...] = (),
    version: int = 3,
    buckets: tuple[int, int] = BUCKETS,
) -> None:
    """Writes SPZ version 3, which most software reads, or version 4.

    Args:
        path: path of the file.
        gaussians: scene to write.
        comments: see `formats.save`.
        version: 3 or 4.
        buckets: numbers of 8-bit levels that are merged into one, for SH degree 1 and for higher degrees.
            Smaller numbers are more precise and make larger files.

    Raises:
        FormatError: if a position is too far away for the format.
    """
    gaussians = half_turn(gaussians, axis=0)
    bits = _fractional_bits(path, gaussians)
    flags = ANTIALIASED if MIP in comments else 0
    streams = [stream.tobytes() for stream in _encode(path, gaussians, bits, buckets)]
    fields = (MAGIC, version, len(gaussians), gaussians.sh_degree, bits, flags)
    if version == 3:
        packed = gzip.compress(HEADER.pack(*fields, 0) + b"".join(streams), GZIP_LEVEL, mtime=0)
    elif version == 4:
        streams = [stream for stream in streams if stream]
        import zstandard

        parts = [zstandard.compress(stream, 19) for stream in streams]
        table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(parts, streams, strict=True))
        packed = HEADER_4.pack(*fields, len(parts), HEADER_4.size) + table + b"".join(parts)
    else:
        raise ValueError(f"SPZ version {version}: 3 or 4 can be written")
    write_whole(path, packed)


def _header(path: Path, contents: bytes) -> Header:
    start = contents[: HEADER_4.size]
    if start[:2] == b"\x1f\x8b":
        start = inflate(path, contents, HEADER.size)
    if len(start) < HEADER.size or not start.startswith(MAGIC):
        raise FormatError(f"{path}: not an SPZ file. Give a file that was saved as .spz.")
    header = Header(*HEADER.unpack_from(start)[1:])
    if not 1 <= header.version <= 4 or (header.version == 4) != (contents[:4] == MAGIC and start[4] == 4):
        raise FormatError(f"{path}: SPZ version {header.version}: splatax reads 1 to 4.")
    if header.degree > MAX_SH_DEGREE or header.fractional_bits > 31:
        raise FormatError(
            f"{path}: damaged: SH degree {header.degree}, {header.fractional_bits} fractional bits."
        )
    if header.version == 4:
        if len(start) < HEADER_4.size:
            raise FormatError(f"{path}: truncated: its header is incomplete. Copy the file again.")
        header = Header(*HEADER_4.unpack(start)[1:])
    return header


def _streams(path: Path, contents: bytes, header: Header) -> list[UInt8[np.ndarray, "n bytes"]]:
    """Returns the bytes of each attribute, one row per Gaussian."""
    sizes = header.sizes()
    if header.version == 4:
        body = b"".join(_zstandard_streams(path, contents, header, [size for size in sizes if size]))
    elif contents[:4] == MAGIC:  # not compressed, like some test files of other software
        body = contents[HEADER.size :]
    else:
        limit = HEADER.size + sum(sizes) + TRAILER
        body = inflate(path, contents, limit + 1)[HEADER.size :]
        if len(body) > limit - HEADER.size:
            raise FormatError(f"{path}: damaged: more data than its {header.count:,} Gaussians need.")
    cursor = Cursor(path, body)
    return [cursor.take("Gaussians", "u1", header.count, size) for size in header.row_sizes()]


def _zstandard_streams(path: Path, contents: bytes, header: Header, sizes: list[int]) -> list[bytes]:
    import zstandard

    cursor = Cursor(path, contents, header.contents)
    table = cursor.take("table of contents", "<u8", header.streams, 2).astype(object)
    if list(table[:, 1]) != sizes or header.contents < HEADER_4.size:
        raise FormatError(
            f"{path}: damaged: its streams do not fit {header.count:,} Gaussians. Copy it again."
        )
    streams = []
    for stored, size in table:
        packed = cursor.take("streams", "u1", stored).tobytes()
        try:
            with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=False) as reader:
                streams.append(reader.read(size + 1))
        except zstandard.ZstdError as error:
            raise FormatError(f"{path}: damaged ({error}). Copy the file again.") from error
        if len(streams[-1]) != size:
            raise FormatError(f"{path}: damaged: a stream is not as long as it claims. Copy the file again.")
    return streams


def _decode(header: Header, positions, alphas, colors, scales, rotations, sh) -> Gaussians:
    n, levels = header.count, (sh.astype(np.float32) - 128) / 128
    dc = (colors.astype(np.float32) / 255 - np.float32(0.5)) / np.float32(COLOR_SCALE)
    if header.version == 1:
        means = np.ascontiguousarray(positions).view("<f2").astype(np.float32)
    else:
        b = positions.reshape(n, 3, 3).astype(np.int32)
        fixed = (b[..., 0] | b[..., 1] << 8 | b[..., 2] << 16) << 8 >> 8  # sign-extended from 24 bits
        means = np.ldexp(fixed.astype(np.float32), -header.fractional_bits)
    if header.version >= 3:
        words = packing.unpack(np.ascontiguousarray(rotations).view("<u4")[:, 0], 2, *[1, 9] * 3)
        others = words[:, 2::2].astype(np.float32) / 511 * packing.SQRT_HALF
        signed = np.where(words[:, 1::2] == 1, -others, others)
        quats = packing.from_smallest_three(words[:, 0].astype(int), signed)
    else:
        xyz = rotations.astype(np.float32) / np.float32(127.5) - 1
        w = np.sqrt(np.maximum(1 - np.sum(np.square(xyz), axis=1), 0))
        quats = np.concatenate([xyz, w[:, None]], axis=1)
    return Gaussians(
        means=jnp.asarray(means.astype(np.float32)),
        quats=jnp.asarray(quats[:, [3, 0, 1, 2]]),
        log_scales=jnp.asarray(scales.astype(np.float32) / 16 - 10),
        opacity_logits=jnp.asarray(packing.opacity_logits(alphas[:, 0])),
        sh=jnp.asarray(np.concatenate([dc[:, None], levels.reshape(n, levels.shape[1] // 3, 3)], axis=1)),
    )


def _encode(
    path: Path, gaussians: Gaussians, fractional_bits: int, buckets: tuple[int, int]
) -> list[np.ndarray]:
    """Returns positions, alphas, colours, scales, rotations and SH in the file's encoding."""
    fixed = np.rint(np.ldexp(np.asarray(gaussians.means, np.float64), fractional_bits)).astype("<i4")
    largest, others = packing.smallest_three(packing.unit(np.asarray(gaussians.quats))[:, XYZW])
    magnitudes = packing.levels(np.abs(others) / packing.SQRT_HALF, 511)
    signed = np.stack([others < 0, magnitudes], axis=2).reshape(-1, 6)
    rotations = packing.pack(np.concatenate([largest[:, None], signed], axis=1), 2, *[1, 9] * 3)
    colors = np.asarray(gaussians.sh[:, 0]) * np.float32(COLOR_SCALE) + np.float32(0.5)
    rest = np.asarray(gaussians.sh[:, 1:])
    bucket = np.where(np.arange(rest.shape[1]) < 3, *buckets)[:, None]
    # Rounded once, to a multiple of the bucket: rounding whole levels again would raise each by half of one.
    levels = np.rint(np.clip(rest, -2, 2) * (128 / bucket).astype(np.float32)) * bucket + 128
    log_scales = np.asarray(gaussians.log_scales)
    if clipped := int(np.sum(log_scales.max(axis=1, initial=-np.inf) > 255 / 16 - 10)):
        warnings.warn(
            f"{path}: {clipped:,} Gaussians are too large for SPZ and were made smaller", stacklevel=4
        )
    return [
        fixed.view("u1").reshape(-1, 3, 4)[..., :3],
        packing.opacity_levels(np.asarray(gaussians.opacity_logits)),
        packing.levels(colors, 255).astype("u1"),
        packing.levels((log_scales + 10) * np.float32(16 / 255), 255).astype("u1"),
        rotations.astype("<u4"),
        np.clip(levels, 0, 255).astype("u1"),
    ]


def _fractional_bits(path: Path, gaussians: Gaussians) -> int:
    """Returns the number of fractional bits that fits the farthest position.

    It is above the default only if Gaussians are tiny.
    """
    if len(gaussians) == 0:
        return DEFAULT_FRACTIONAL_BITS
    farthest = float(np.abs(np.asarray(gaussians.means)).max())
    room = 23 - int(np.ceil(np.log2(max(farthest * (1 + 1e-6), 2.0**-7))))
    if room < 0:
        raise FormatError(
            f"{path}: SPZ has no number for a position as far as {farthest:.3g}. Clean the scene first."
        )
    typical = float(np.exp(np.median(np.asarray(gaussians.log_scales))))
    fine = int(np.ceil(np.log2(10 / max(typical, 1e-6))))  # resolves a tenth of a typical Gaussian's size
    return min(room, max(fine, DEFAULT_FRACTIONAL_BITS))
