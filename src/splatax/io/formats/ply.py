"""INRIA's .ply, which every splatting tool reads. SuperSplat's compressed .ply is recognised too.

    x y z  nx ny nz  f_dc_0..2  f_rest_0..(3K-1)  opacity  scale_0..2  rot_0..3         all float32

Opacity is a logit, scales are logarithms, rotations are (w, x, y, z). `f_rest` is channel-major:
all K higher coefficients of red, then of green, then of blue. Normals are zeros. The format is lossless.

Exactly flat Gaussians of a scene that is drawn along rays have a tiny third scale in the file, which programs
that do not know discs can draw and compress. INRIA's files of discs have no third scale.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io.formats import compressed_ply, ply_table
from splatax.io.formats.marks import DISCS, MARKS
from splatax.io.formats.packing import LEAST_LOG_SCALE
from splatax.io.formats.tolerance import Tolerance
from splatax.low_pass import AlongRays, Dilation
from splatax.math import harmonics

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
RGB = ("red", "green", "blue")
OPACITY = ("opacity",)
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

FLAT = np.float32(LEAST_LOG_SCALE)  # third log scale of exactly flat discs
MAX_SH_DEGREE = 4
LOSES = "nothing: every number is kept, bit by bit."
KEPT_MARKS = MARKS
TOLERANCE = Tolerance()


def load(path: Path) -> Gaussians:
    """Reads columns by name, in any order and precision; other columns are ignored.

    A file without `scale_2` has flat Gaussians that are drawn along rays (2DGS). A file without
    `f_dc` has 8-bit red, green and blue.

    Raises:
        FormatError: if the file is not a PLY file of splats, or is truncated.
    """
    table = ply_table.read(path)
    if "chunk" in table.elements:
        return compressed_ply.decode(path, table)
    vertex = table.elements.get("vertex")
    names = set(vertex.dtype.names or ()) if vertex is not None else set()
    color = DC if names.issuperset(DC) else RGB
    missing = {*POSITION, *OPACITY, *SCALE[:2], *ROTATION, *color} - names
    if vertex is None or missing:
        kind = "a point cloud or mesh" if names.issuperset(POSITION) else "something else"
        raise FormatError(
            f"{path}: {kind}, not splats: it has no {', '.join(sorted(missing))}. "
            "Give a file of trained Gaussians, such as the scene.ply of a run."
        )

    def columns(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([vertex[name].astype(np.float32) for name in names], axis=1)

    dc = columns(DC) if color is DC else harmonics.from_rgb(columns(RGB) / 255)
    flat = "scale_2" not in names
    log_scales = columns(SCALE[:2] if flat else SCALE)
    if flat:
        log_scales = np.pad(log_scales, ((0, 0), (0, 1)), constant_values=-np.inf)
    elif DISCS in table.comments:
        log_scales[:, 2] = np.where(log_scales[:, 2] == FLAT, -np.inf, log_scales[:, 2])
    return Gaussians(
        means=jnp.asarray(columns(POSITION)),
        quats=jnp.asarray(columns(ROTATION)),
        log_scales=jnp.asarray(log_scales),
        opacity_logits=jnp.asarray(columns(OPACITY)[:, 0]),
        sh=jnp.asarray(np.concatenate([dc[:, None], _higher_bands(path, vertex)], axis=1)),
        low_pass=AlongRays() if flat else Dilation(),
    )


def save(path: Path, gaussians: Gaussians, *, comments: tuple[str, ...] = ()) -> None:
    """Writes Gaussians; see `formats.save`."""
    log_scales = np.asarray(gaussians.log_scales)
    fields = {
        POSITION: np.asarray(gaussians.means),
        NORMAL: np.zeros((len(gaussians), 3), np.float32),
        DC: np.asarray(gaussians.sh[:, 0]),
        _rest_names(gaussians.sh.shape[1] - 1): _channel_major(np.asarray(gaussians.sh[:, 1:])),
        OPACITY: np.asarray(gaussians.opacity_logits)[:, None],
        SCALE: _finite(log_scales) if DISCS in comments else log_scales,
        ROTATION: np.asarray(gaussians.quats),
    }
    names = [name for group in fields for name in group]
    values = np.ascontiguousarray(np.concatenate(list(fields.values()), axis=1), "<f4")
    rows = values.view([(name, "<f4") for name in names])[:, 0]
    ply_table.write(path, {"vertex": rows}, (*comments, f"SH degree: {gaussians.sh_degree}"))


def _finite(log_scales: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns log scales with a number in place of -inf."""
    return np.where(np.isneginf(log_scales), FLAT, log_scales)


def comments(path: Path) -> tuple[str, ...]:
    """Returns the comments in the header."""
    return ply_table.read(path).comments


def _rest_names(coefficients: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(3 * coefficients))


def _channel_major(rest: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n rest"]:
    return rest.transpose(0, 2, 1).reshape(len(rest), 3 * rest.shape[1])


def _higher_bands(path: Path, vertex: np.ndarray) -> Float[np.ndarray, "n k 3"]:
    found = [name for name in vertex.dtype.names or () if name.startswith("f_rest_")]
    names = _rest_names(len(found) // 3)
    if harmonics.degree_of_file(len(found)) is None or set(names) != set(found):
        raise FormatError(
            f"{path}: {len(found)} f_rest columns: expected 0, 9, 24, 45 or 72, numbered from 0."
        )
    rest = np.empty((len(vertex), len(names)), np.float32)
    for i, name in enumerate(names):
        rest[:, i] = vertex[name]
    return rest.reshape(len(vertex), 3, len(names) // 3).transpose(0, 2, 1)
