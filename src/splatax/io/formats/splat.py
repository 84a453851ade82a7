"""antimatter15's .splat, which every web viewer reads: 32 bytes per Gaussian, and no header.

    float32 position[3]   float32 scale[3]   uint8 RGBA   uint8 rotation (w, x, y, z) * 128 + 128

Scales are linear. The most important Gaussians come first, so that a viewer can start to draw early.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.files import write_whole
from splatax.io.formats import packing
from splatax.io.formats.tolerance import Tolerance
from splatax.math import harmonics

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

MAX_SH_DEGREE = 4  # accepted degree; only the first coefficient is written
LOSES = (
    "all view dependence (SH above degree 0); colours and opacities are rounded to 8 bits and clipped "
    "to 0-1, rotations to 8 bits; the order changes."
)
KEPT_MARKS: tuple[str, ...] = ()
TOLERANCE = Tolerance(degrees=1.5, log_scales=1e-5, opacities=3e-3, dc=0.01, sh=None)


def load(path: Path) -> Gaussians:
    """Reads Gaussians whose colour does not depend on the view.

    Raises:
        FormatError: if the bytes cannot be those of a .splat file. The format has no magic number.
    """
    contents = path.read_bytes()
    if len(contents) % ROW.itemsize:
        raise FormatError(
            f"{path}: truncated, or not a .splat file: {len(contents):,} bytes are not a multiple of "
            f"{ROW.itemsize}. Copy the file again."
        )
    rows = np.frombuffer(contents, ROW)
    # The condition is negated so that it catches NaN too.
    if not (
        np.isfinite(rows["mean"]).all() and (rows["scale"] >= 0).all() and (rows["scale"] < np.inf).all()
    ):
        raise FormatError(f"{path}: not a .splat file: some positions or sizes are no numbers, or negative.")
    with np.errstate(divide="ignore"):
        log_scales = np.log(rows["scale"])
    rgb = rows["rgba"][:, :3].astype(np.float32) / 255
    return Gaussians(
        means=jnp.asarray(rows["mean"]),
        quats=jnp.asarray((rows["quat"].astype(np.float32) - 128) / 128),
        log_scales=jnp.asarray(log_scales),
        opacity_logits=jnp.asarray(packing.opacity_logits(rows["rgba"][:, 3])),
        sh=jnp.asarray(harmonics.from_rgb(rgb)[:, None].astype(np.float32)),
    )


def comments(path: Path) -> tuple[str, ...]:
    """Returns no comments, because the format cannot hold any."""
    return ()


def save(path: Path, gaussians: Gaussians, *, comments: tuple[str, ...] = ()) -> None:
    """Writes the view-independent colour of each Gaussian. Comments are not kept."""
    rows = np.empty(len(gaussians), ROW)
    rows["mean"] = np.asarray(gaussians.means)
    rows["scale"] = np.exp(np.minimum(np.asarray(gaussians.log_scales), np.float32(80)))
    rows["rgba"][:, :3] = packing.levels(harmonics.to_rgb(np.asarray(gaussians.sh[:, 0])), 255)
    rows["rgba"][:, 3] = packing.opacity_levels(np.asarray(gaussians.opacity_logits))
    quats = packing.unit(np.asarray(gaussians.quats))
    rows["quat"] = np.clip(np.rint(quats * 128 + 128), 0, 255)
    importance = np.prod(rows["scale"].astype(np.float64), axis=1) * rows["rgba"][:, 3]
    write_whole(path, rows[np.argsort(-importance, kind="stable")].tobytes())
