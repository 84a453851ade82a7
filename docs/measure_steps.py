"""Measures the CPU time and the peak memory of training steps on the machine's own CPU.

python docs/measure_steps.py GAUSSIANS SEEN PAST RECIPE STEPS
    GAUSSIANS   number of Gaussians, of which the fraction SEEN is in view, in no order
    PAST        of those out of view: "never" seen, seen "long" ago, or seen "lately"
    RECIPE      name of a preset

It prints milliseconds of CPU time of all threads for a step, median and minimum, the system's part of them,
page faults, and the peak memory of the process during the steps for each Gaussian. To compare two versions,
run it with one and the other in turn.
"""

import resource
import statistics
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from splatax import backends
from splatax.bench.operations import images
from splatax.bench.scenes import procedural
from splatax.gaussians import Gaussians
from splatax.training.feed import Batch
from splatax.training.loop import first_state
from splatax.training.recipes import PRESETS
from splatax.training.step import TrainState, train_step

SIZE = (504, 378)
DRAWN = 1_000_000  # Gaussians that are drawn at random; larger scenes are made of copies
WARM = 3  # steps before the first that is measured


def scene_of(count: int, seen: float) -> tuple[Gaussians, Batch]:
    """Returns a scene of which a camera sees a fraction, and a photo of it."""
    drawn = procedural(min(count, DRAWN), SIZE)
    copies = -(-count // DRAWN)
    rng = np.random.default_rng(1)

    def repeated(leaf: jax.Array) -> np.ndarray:
        rows = np.asarray(leaf)
        found = np.empty((count, *rows.shape[1:]), np.float32)
        for first in range(0, count, len(rows)):
            found[first : first + len(rows)] = rows[: count - first]
        return found

    gaussians = jax.tree.map(repeated, drawn.gaussians)
    gaussians.means[:, :2] += rng.normal(0, 1e-3 * (copies > 1), (count, 2)).astype(np.float32)
    gaussians.means[rng.uniform(size=count) >= seen, 0] += 1e3
    gaussians.log_scales[:] -= np.float32(0.5 * np.log(copies))
    _, photo = images(SIZE[1], SIZE[0])
    return jax.tree.map(jnp.asarray, gaussians), Batch(drawn.camera, jnp.round(photo * 255).astype(jnp.uint8))


def with_past(state: TrainState, past: str) -> TrainState:
    """Returns a state whose moments are those of Gaussians that were seen never, long ago or lately."""
    adam, *rest = state.opt_state
    if past != "never":
        adam = adam._replace(nu=jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e-12), adam.nu))
    if past == "lately":
        adam = adam._replace(mu=jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e-6), adam.mu))
    return replace(state, opt_state=(adam, *rest))


def used() -> tuple[float, float, int]:
    """Returns milliseconds of CPU time of the process, the system's part, and the number of page faults."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return 1e3 * (usage.ru_utime + usage.ru_stime), 1e3 * usage.ru_stime, usage.ru_minflt


def memory(name: str) -> int:
    """Returns a number of bytes from the status of the process, such as "VmHWM" (Linux only)."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) * 1024


def main(count: int, seen: float, past: str, name: str, steps: int) -> None:
    """Prints what the module's text says."""
    gaussians, batch = scene_of(count, seen)
    recipe = PRESETS[name].build(30_000).on(backends.resolve("cpu"))
    # A small extent keeps the means in place, so that each step does the same work.
    state = with_past(first_state(gaussians, recipe, extent=1e-6, photos=1), past)
    del gaussians
    jax.block_until_ready(state)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    found = []
    for step in range(WARM + steps):
        before = used()
        state, loss = train_step(state, batch, recipe)
        jax.block_until_ready((state, loss))
        if step >= WARM:
            found.append([b - a for a, b in zip(before, used(), strict=True)])
    whole, system, faults = zip(*found, strict=True)
    print(
        f"{count:,} {seen:g} {past} {name}: {statistics.median(whole):.0f} ({min(whole):.0f}) ms, "
        f"system {statistics.median(system):.0f} ms, {statistics.median(faults):.0f} faults, "
        f"peak {memory('VmHWM') / count:.0f} bytes for each Gaussian, loss {float(loss):.6f}"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3], sys.argv[4], int(sys.argv[5]))
