"""PlayCanvas' .sog (version 2): lossless WebP textures and a meta.json, in a zip file or a folder.

    means_l, means_u   16 bits of sign(x) log(1 + |x|), between mins and maxs
    quats              the smallest three, times sqrt 2, in 8 bits; A is 252 + the index of the largest
    scales, sh0        indices into codebooks of log scales and of DC; sh0's A is opacity
    shN                a label for each Gaussian, into a palette of all its higher coefficients

A Gaussian is the same pixel in every texture except the palette. Its axes are those of splatax.
(developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog)
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from splatax.errors import FormatError
from splatax.gaussians import Gaussians, rows_of
from splatax.io.files import write_whole
from splatax.io.formats import packing
from splatax.io.formats.marks import MARKS, MIP
from splatax.io.formats.tolerance import Tolerance
from splatax.io.formats.untrusted import check_expansion
from splatax.math import clusters, harmonics, morton

META = "meta.json"
MAX_META = 1 << 20  # bytes
TEXTURES = 6  # each of 4 bytes per Gaussian
COLUMNS = 64  # palette entries in a row of the texture
MAX_PALETTE = 65_536  # entries; labels have 16 bits
CODES = 256
LARGEST_ROTATION = 252  # in channel A of quats: 252 to 255 for w, x, y, z

MAX_SH_DEGREE = 3
LOSES = (
    "positions are rounded to 16 bits, rotations, opacities, scales and colours to 8; higher SH is taken "
    "from a palette of at most 65,536 entries; the order changes."
)
KEPT_MARKS = MARKS
TOLERANCE = Tolerance(means=1e-4, degrees=1.1, log_scales=0.02, opacities=3e-3, dc=0.03, sh=0.05)


class Folder:
    """Files of a scene, in a zip file or beside a meta.json."""

    def __init__(self, path: Path):
        self.path = path
        self.zip = None if path.name.endswith(META) else zipfile.ZipFile(path)
        self.stored = path.stat().st_size if self.zip else 0

    def read(self, name: str, limit: int) -> bytes:
        """Reads a file of at most `limit` bytes."""
        if self.zip:
            with self.zip.open(name) as file:
                contents = file.read(limit + 1)
        else:
            if Path(name).name != name:
                raise FormatError(f"{self.path}: names a file outside its folder, {name!r}.")
            contents = (self.path.parent / name).read_bytes()
            self.stored += len(contents)
        if len(contents) > limit:
            raise FormatError(f"{self.path}: damaged: {name} is larger than {limit:,} bytes.")
        return contents

    def meta(self) -> dict[str, Any]:
        """Reads meta.json."""
        name = self.path.name if self.zip is None else META
        meta = json.loads(self.read(name, MAX_META))
        if meta.get("version") != 2:
            raise FormatError(
                f"{self.path}: SOG version {meta.get('version', 1)}: splatax reads 2. "
                "Convert it first: npx @playcanvas/splat-transform old.sog new.sog."
            )
        return meta

    def texture(self, name: str, pixels: int) -> UInt8[np.ndarray, "n 4"]:
        """Reads the first pixels of an image.

        Raises:
            FormatError: if the image has fewer pixels, or far more.
        """
        from PIL import Image

        contents = self.read(name, 4 * pixels + MAX_META)
        check_expansion(self.path, 4 * pixels * TEXTURES, max(self.stored, len(contents)))
        with Image.open(io.BytesIO(contents), formats=("WEBP", "PNG")) as image:
            size = image.width * image.height
            if not pixels <= size <= 4 * pixels + MAX_META:
                raise FormatError(
                    f"{self.path}: damaged: {name} has {size:,} pixels for {pixels:,} Gaussians."
                )
            return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:pixels]


def load(path: Path) -> Gaussians:
    """Reads a zip file, or a folder given its meta.json.

    Raises:
        FormatError: if the file is neither, or is damaged.
    """
    folder = Folder(path)
    meta = folder.meta()
    count = int(meta["count"])
    if count < 1:
        raise FormatError(f"{path}: damaged: {count} Gaussians.")

    def texture(part: str, index: int = 0) -> np.ndarray:
        return folder.texture(meta[part]["files"][index], count)

    low, high = (texture("means", i)[:, :3].astype(np.uint16) for i in (0, 1))
    mins, maxs = (np.array(meta["means"][key], np.float64).reshape(3) for key in ("mins", "maxs"))
    logs = mins + (maxs - mins) * ((high << 8 | low) / 65535)
    quats, color = texture("quats"), texture("sh0")
    others = (quats[:, :3].astype(np.float32) / 255 * 2 - 1) * packing.SQRT_HALF
    largest = quats[:, 3].astype(int) - LARGEST_ROTATION
    if largest.min() < 0:
        raise FormatError(f"{path}: damaged: its rotations are not those of a SOG file.")
    dc = _codes(meta["sh0"])[color[:, :3]]
    rest = _palette(folder, meta["shN"], count) if "shN" in meta else np.zeros((count, 0, 3), np.float32)
    return Gaussians(
        means=jnp.asarray(np.sign(logs) * np.expm1(np.abs(logs)), jnp.float32),
        quats=jnp.asarray(packing.from_smallest_three(largest, others)),
        log_scales=jnp.asarray(_codes(meta["scales"])[texture("scales")[:, :3]]),
        opacity_logits=jnp.asarray(packing.opacity_logits(color[:, 3])),
        sh=jnp.asarray(np.concatenate([dc[:, None], rest], axis=1)),
    )


def comments(path: Path) -> tuple[str, ...]:
    """Returns the comment lines that `save` wrote, and the mark of antialiasing that any tool wrote."""
    meta = Folder(path).meta()
    lines = [str(line) for line in (meta.get("extras") or {}).get("comments", ())]
    return tuple(dict.fromkeys([*lines, *([MIP] if meta.get("antialias") else [])]))


def save(path: Path, gaussians: Gaussians, *, comments: tuple[str, ...] = ()) -> None:
    """Writes a zip file, with Gaussians in Morton order.

    Raises:
        FormatError: if the scene is empty.
    """
    if len(gaussians) == 0:
        raise FormatError(f"{path}: a SOG file needs at least one Gaussian.")
    order = morton.order(np.asarray(gaussians.means))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:  # stored, because WebP does not compress further
        for name, contents in files_of(rows_of(gaussians, order), comments).items():
            zipped.writestr(zipfile.ZipInfo(name), contents)
    write_whole(path, archive.getvalue())


def files_of(gaussians: Gaussians, comments: tuple[str, ...]) -> dict[str, bytes]:
    """Returns the files of a scene by name, meta.json first, with its Gaussians in their order."""
    logs = np.asarray(gaussians.means, np.float64)
    logs = np.sign(logs) * np.log1p(np.abs(logs))
    mins, maxs = logs.min(axis=0), logs.max(axis=0)
    words = np.rint((logs - mins) / np.where(maxs > mins, maxs - mins, 1) * 65535).astype(np.uint16)
    largest, others = packing.smallest_three(packing.unit(np.asarray(gaussians.quats)))
    rotations = packing.levels(others / packing.SQRT_HALF / 2 + np.float32(0.5), 255)
    log_scales = packing.finite_log_scales(np.asarray(gaussians.log_scales)).ravel()
    # Errors are more visible in larger Gaussians.
    seen = np.exp(log_scales.astype(np.float64) - log_scales.max())
    scales, scale_of = clusters.codebook(log_scales, CODES, weights=seen)
    colors, color_of = clusters.codebook(np.asarray(gaussians.sh[:, 0]).ravel(), CODES)
    opacities = packing.opacity_levels(np.asarray(gaussians.opacity_logits))
    textures = {
        "means_l.webp": words & 255,
        "means_u.webp": words >> 8,
        "quats.webp": np.concatenate([rotations, LARGEST_ROTATION + largest[:, None]], axis=1),
        "scales.webp": scale_of.reshape(-1, 3),
        "sh0.webp": np.concatenate([color_of.reshape(-1, 3), opacities[:, None]], axis=1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "splatax"},
        "extras": {"comments": list(comments)},
        "count": len(gaussians),
        "antialias": MIP in comments,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    files = {name: _webp(_square(values)) for name, values in textures.items()}
    if gaussians.sh_degree > 0:
        meta["shN"], palette = _save_palette(np.asarray(gaussians.sh[:, 1:]))
        files |= palette
    return {META: json.dumps(meta).encode(), **files}


def _codes(part: dict[str, Any]) -> Float[np.ndarray, " 256"]:
    codes = np.array(part["codebook"], np.float32).reshape(-1)
    return np.pad(codes[:CODES], (0, max(0, CODES - len(codes))), mode="edge")


def _palette(folder: Folder, part: dict[str, Any], count: int) -> Float[np.ndarray, "n k 3"]:
    """Returns each Gaussian's higher SH coefficients."""
    entries, bands = int(part["count"]), int(part["bands"])
    if not (1 <= entries <= MAX_PALETTE and 1 <= bands <= MAX_SH_DEGREE):
        raise FormatError(f"{folder.path}: damaged: a palette of {entries:,} entries with {bands} bands.")
    width = harmonics.count(bands) - 1
    pixels = folder.texture(part["files"][0], math.ceil(entries / COLUMNS) * COLUMNS * width)
    labels = folder.texture(part["files"][1], count).astype(int)
    label = labels[:, 0] | labels[:, 1] << 8
    if label.max() >= entries:
        raise FormatError(f"{folder.path}: damaged: label {label.max():,} in a palette of {entries:,}.")
    return _codes(part)[pixels[:, :3].reshape(-1, width, 3)[label]]


def _save_palette(rest: Float[np.ndarray, "n k 3"]) -> tuple[dict[str, Any], dict[str, bytes]]:
    n, width = rest.shape[:2]
    size = min(MAX_PALETTE, max(1024, 2 ** int(math.log2(max(n, 1)))))
    centres, labels = clusters.palette(np.ascontiguousarray(rest.reshape(n, -1)), size)
    codes, code_of = clusters.codebook(centres.ravel(), CODES)
    pixels = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    files = {
        "shN_centroids.webp": _webp(code_of.reshape(size // COLUMNS, COLUMNS * width, 3)),
        "shN_labels.webp": _webp(_square(pixels)),
    }
    bands = harmonics.degree_of(width + 1)
    return {"count": size, "bands": bands, "codebook": codes.tolist(), "files": list(files)}, files


def _square(values: np.ndarray) -> np.ndarray:
    """Returns one row per Gaussian as an image whose sides are multiples of 4."""
    width = math.ceil(math.sqrt(len(values)) / 4) * 4
    height = math.ceil(len(values) / width / 4) * 4
    padded = np.zeros((width * height, values.shape[1]), np.uint8)
    padded[: len(values)] = values
    return padded.reshape(height, width, -1)


def _webp(pixels: np.ndarray) -> bytes:
    """Encodes an image as lossless WebP that keeps the colours of transparent pixels.

    A higher `method` does not make the file smaller.
    """
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(
        file, "WEBP", lossless=True, exact=True, quality=75, method=4
    )
    return file.getvalue()
