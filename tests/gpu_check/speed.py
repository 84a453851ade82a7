"""The speed of the backend on this device. Everything here is measured, except `COUNTED`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gpu_check.plan import Plan, library
from splatax.backends.cuda.library import load
from splatax.bench.operations import operations
from splatax.bench.scenes import procedural
from splatax.bench.timing import interleaved, timed

# Milliseconds at 1M Gaussians and 1920 x 1080, not measured: counted operations and bytes of the algorithm,
# over the peak of an H100 SXM (132 multiprocessors, 4 warp instructions a cycle at 1.755 GHz, 3.0 TB/s).
COUNTED = {"render": 0.49, "rasterize F+B": 1.2, "training step": 2.0}
COUNTED_AT = 1_000_000


def bandwidth(plan: Plan) -> dict[str, Any]:
    """Measures how fast an array is read and written: the upper bound of everything that moves arrays."""
    array = jnp.zeros(plan.copied // 4, jnp.float32)
    add = jax.jit(lambda array: array + 1)
    timed(lambda: add(array))
    milliseconds = float(np.median([timed(lambda: add(array)) for _ in range(plan.rounds)]))
    return {"GB/s": 2 * plan.copied / milliseconds / 1e6}


def scenes(plan: Plan) -> dict[str, Any]:
    """Times each operation, and each kernel of a training step, for scenes of several sizes."""
    return {f"{count:,}": scene(plan, count) for count in plan.counts}


def scene(plan: Plan, count: int) -> dict[str, Any]:
    """Returns medians and minima of the operations and times of kernels, in milliseconds."""
    timed_operations = operations(procedural(count, plan.size), "cuda")
    *_, timings = interleaved(timed_operations, plan.rounds)
    found: dict[str, Any] = {
        name: {"median": timing.median, "minimum": timing.minimum} for name, timing in timings.items()
    }
    if count == COUNTED_AT:
        for name, least in COUNTED.items():
            found[name]["counted"] = least
    return found | {"kernels of a training step": kernels(timed_operations["training step"])}


def kernels(operation) -> dict[str, Any]:
    """Returns launches and milliseconds of each kernel in one call of an operation."""
    handlers = load(library().path)
    handlers.splatax_cuda_take_profile()
    handlers.splatax_cuda_set_profile(1)
    try:
        timed(operation)
    finally:
        handlers.splatax_cuda_set_profile(0)
    lines = handlers.splatax_cuda_take_profile().decode().splitlines()
    found = {}
    for name, launches, least, total in (line.split() for line in lines):
        found[name] = {"launches": int(launches), "least": float(least), "total": float(total)}
    assert found, "no kernel was profiled"
    return found
