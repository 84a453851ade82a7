"""Roofline of the rasterizer: the time that its arithmetic alone takes at the machine's measured peak.

A slot is a pixel at which a splat is evaluated. The forward pass takes 33 operations per slot: exponent 10,
exp2 13, alpha, transmittance and weight 4, three channels 6. The backward pass takes 62: the same again
without channels, and 35 of its own. These are counts of native/cpu/chunk.h, blending.h and gradient.h, with a
fused multiply-add as two operations and comparisons as none.
"""

import os
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from splatax.backends.cpu import MAX_PAIRS, Build, library
from splatax.bench.timing import timed
from splatax.splats import Splats

TILE = 16  # pixels per side, as in native/cpu/splats.h
FLOPS = {"rasterize": 33, "rasterize F+B": 33 + 62}  # operations per slot
CHAINS, LANES = 12, 16  # as in native/cpu/roofline.h and lanes.h
ROUNDS, TRIES = 2_000_000, 5  # of the measurement of the peak; a try takes about 0.1 s


@dataclass(frozen=True)
class Slots:
    """Numbers of slots of one image: evaluated by the native rasterizer, and drawn."""

    evaluated: int
    drawn: int


def slots(splats: Splats) -> Slots | None:
    """Counts the slots of a view; None if the native library is not available."""
    if library.why_unavailable(None):
        return None
    tiles = -(-splats.width // TILE) * -(-splats.height // TILE)
    fields = (splats.means2d, splats.sqrt_conics, splats.depths, splats.extents, splats.opacities)
    (counts,) = Build().call(
        "splatax_slots",
        [jax.ShapeDtypeStruct((tiles, 2), jnp.int32)],
        [*fields, splats.colors],
        max_pairs=np.int64(MAX_PAIRS),
        width=np.int64(splats.width),
        height=np.int64(splats.height),
    )
    evaluated, drawn = np.asarray(counts, np.int64).sum(axis=0).tolist()
    return Slots(evaluated, drawn)


def peak_flops() -> float | None:
    """Measures the peak arithmetic of all threads together, in operations per second.

    The threads run chains of fused multiply-adds that touch no memory; the best of a few tries counts.
    The result is None if the native library is not available.
    """
    if library.why_unavailable(None):
        return None
    build = Build()

    def work() -> jax.Array:
        (sums,) = build.call("splatax_multiply_adds", [(os.cpu_count() or 1,)], [], rounds=np.int64(ROUNDS))
        return sums

    threads = np.count_nonzero(work())
    milliseconds = min(timed(work) for _ in range(TRIES))
    return 2 * threads * ROUNDS * CHAINS * LANES / milliseconds * 1e3


def shortest(operation: str, counted: Slots, flops: float) -> float | None:
    """Returns the milliseconds of an operation's arithmetic at the peak; None if it is not counted."""
    return FLOPS[operation] * counted.evaluated / flops * 1e3 if operation in FLOPS else None
