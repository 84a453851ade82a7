"""The speed of the backend on this device. Everything here is measured, except `COUNTED`."""

import traceback
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gpu_check.plan import Plan, library
from splatax.backends.cuda.library import load
from splatax.bench.operations import Operation, projection, rasterizer, training, viewing
from splatax.bench.scenes import procedural
from splatax.bench.timing import interleaved, timed

# Milliseconds at 1M Gaussians and 1920 x 1080, not measured: counted operations and bytes of the algorithm,
# over the peak of an H100 SXM (132 multiprocessors, 4 warp instructions a cycle at 1.755 GHz, 3.0 TB/s).
COUNTED = {"project": 0.10, "render": 0.49, "rasterize F+B": 1.2, "Adam": 0.55, "training step": 2.0}
COUNTED_AT = 1_000_000
PARTS = {  # of a training step: what its kernels are called, and what is counted for them
    "projection": (("project",), 0.10),
    "binning and sorts": (
        ("count_", "order_", "emit_", "find_", "sum_run", "add_run", "move_items"),
        0.13,
    ),
    "blend, gradient, records": (("blend_", "add_records_"), 1.02),
    "gradient of the projection": (("project_gradient", "sum_camera_parts"), 0.17),
    "loss": (("photometric_", "sum_loss_parts"), 0.07),
    "Adam": (("move_rows",), 0.55),
}
# Bytes that a step of Adam reads and writes for each number of the scene that moves: its value, gradient and
# both moments are read, and all but the gradient are written.
ADAM_BYTES = 7 * 4


def bandwidth(plan: Plan) -> dict[str, Any]:
    """Measures how fast an array is read and written: the upper bound of everything that moves arrays."""
    return {"GB/s": copied_gigabytes(plan)}


@cache
def copied_gigabytes(plan: Plan) -> float:
    """Returns the gigabytes that the device reads and writes in a second."""
    array = jnp.zeros(plan.copied // 4, jnp.float32)
    add = jax.jit(lambda array: array + 1)
    timed(lambda: add(array))
    milliseconds = float(np.median([timed(lambda: add(array)) for _ in range(plan.rounds)]))
    return 2 * plan.copied / milliseconds / 1e6


def scenes(plan: Plan) -> dict[str, Any]:
    """Times each operation, and each kernel of a training step, for scenes of several sizes."""
    found: dict[str, Any] = {}
    for count in plan.counts:
        try:
            found[f"{count:,}"] = scene(plan, count)
        except Exception:  # such as too little memory for the largest scene: the others are reported
            found |= {f"{count:,}": {"error": traceback.format_exc()}, "passed": False}
    return found


def scene(plan: Plan, count: int) -> dict[str, Any]:
    """Returns medians and minima of the operations and times of kernels, in milliseconds."""
    drawn = procedural(count, plan.size)
    timed_operations: dict[str, Operation] = {}
    for some in (projection, rasterizer, viewing, training):
        timed_operations |= some(drawn, "cuda")
    *_, timings = interleaved(timed_operations, plan.rounds)
    found: dict[str, Any] = {
        name: {"median": timing.median, "minimum": timing.minimum} for name, timing in timings.items()
    }
    numbers = sum(leaf.size for leaf in jax.tree.leaves(drawn.gaussians))
    moved = ADAM_BYTES * numbers / timings["Adam"].median / 1e6
    found["Adam"] |= {"GB/s": moved, "of the copy bandwidth": moved / copied_gigabytes(plan)}
    by_kernel = kernels(timed_operations["training step"])
    by_part = parts(by_kernel)
    if count == COUNTED_AT:
        for name, least in COUNTED.items():
            found[name]["counted"] = least
        for name, (_, least) in PARTS.items():
            by_part[name]["counted"] = least
    return found | {"parts of a training step": by_part, "kernels of a training step": by_kernel}


def parts(by_kernel: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Returns the milliseconds of the parts of a training step, each the sum over its kernels."""
    found = {name: {"total": 0.0} for name in PARTS}
    for kernel, times in by_kernel.items():
        named = [
            (len(prefix), name)
            for name, (prefixes, _) in PARTS.items()
            for prefix in prefixes
            if kernel.startswith(prefix)
        ]
        assert named, f"kernel {kernel} belongs to no part of a training step"
        found[max(named)[1]]["total"] += times["total"]
    return found


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
