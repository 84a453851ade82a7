"""Draws the time of the native rasterizer over Gaussians, pixels and threads.

    python docs/make_scaling.py

The script writes docs/images/scaling.png, and prints the numbers.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import splatax as sx
from splatax.backends import cpu
from splatax.bench.scenes import procedural
from splatax.bench.timing import interleaved
from splatax.cli.platform import keep_freed_memory

COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = ((252, 189), (504, 378), (1008, 756), (2016, 1512))
SIZE, COUNT, ROUNDS = (504, 378), 150_000, 15


def gradient(count: int, size: tuple[int, int], threads: int = cpu.ALL_THREADS):
    """Returns an operation that runs the rasterizer forward and backward on a procedural scene."""
    scene, rasterizer = procedural(count, size), cpu.kernels(threads=threads)
    splats = sx.project(scene.gaussians, scene.camera)

    @jax.jit
    def work(splats):
        def total(splats):
            sums, alpha = rasterizer.composite(splats, splats.colors)
            return jnp.sum(sums) + jnp.sum(alpha)

        return jax.value_and_grad(total)(splats)

    return lambda: work(splats)


def main() -> None:
    keep_freed_memory()
    threads = [2**k for k in range(10) if 2**k <= (os.cpu_count() or 1)]
    panels = {
        "Gaussians": (COUNTS, [gradient(count, SIZE) for count in COUNTS]),
        "pixels": ([w * h for w, h in SIZES], [gradient(COUNT, size) for size in SIZES]),
        "threads": (threads, [gradient(COUNT, SIZE, number) for number in threads]),
    }
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for axes, (name, (places, operations)) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        *_, timings = interleaved({str(x): f for x, f in zip(places, operations, strict=True)}, ROUNDS)
        medians = np.array([timings[str(x)].median for x in places])
        minima = np.array([timings[str(x)].minimum for x in places])
        print(
            name,
            *(f"{x:,}: {a:.1f} ({b:.1f})" for x, a, b in zip(places, medians, minima, strict=True)),
            sep="  ",
        )
        axes.loglog(places, medians, "o-", label="median")
        axes.loglog(places, minima, ".:", label="minimum")
        power = -1 if name == "threads" else 1
        axes.loglog(
            places,
            minima[-1] * (np.array(places) / places[-1]) ** power,
            "k--",
            lw=0.7,
            label="in proportion",
        )
        axes.set(xlabel=name, ylabel="ms, forward and backward")
        axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(Path(__file__).parent / "images" / "scaling.png", dpi=110)


if __name__ == "__main__":
    main()
