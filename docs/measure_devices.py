"""Measures the cost of dividing a training step among devices: two against one, and a named one against none.

python docs/measure_devices.py [GAUSSIANS WIDTH HEIGHT ROUNDS SEEN]
    SEEN        fraction of the Gaussians that the photos show, in no order; 1 by default

Steps of several ways are made in turn, so that other work on the machine disturbs all alike. Each has the
same scene, a sheet of Gaussians with the statistics of a trained scene, and photos of it. A ratio is the
median of those of all rounds, with the quartiles.
"""

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import jax

jax.config.update("jax_num_cpu_devices", 2)  # before JAX is used

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import splatax as sx  # noqa: E402
from splatax.bench.scenes import Scene, procedural  # noqa: E402
from splatax.evaluation import picture  # noqa: E402
from splatax.training.capacity import bucket_for, pad  # noqa: E402
from splatax.training.density import NoDensityControl  # noqa: E402
from splatax.training.loop import Progress, RunState, first_state, optimize  # noqa: E402
from splatax.training.recipes import ShSchedule, with_views  # noqa: E402

DEFAULTS = "100000", "504", "378", "20", "1"
VIEWS, AT_ONCE = 8, 4  # photos of a step; steps between two looks at the clocks
WAYS = {  # photos of a step and number of devices; None if none is named
    "1 photo": (1, None),
    "1 photo on a device that is named": (1, 1),
    f"{VIEWS} photos on 1 device": (VIEWS, 1),
    f"{VIEWS} photos on 2 devices": (VIEWS, 2),
}
PAIRS = (
    ("1 photo on a device that is named", "1 photo"),
    (f"{VIEWS} photos on 2 devices", f"{VIEWS} photos on 1 device"),
)


def steps_of(scene: Scene, views: int, devices: int | None) -> Iterator[Progress]:
    """Yields the steps of a long run without density control on photos of a scene."""
    photo = np.asarray(picture(scene.gaussians, scene.camera))
    photos = tuple(sx.View(f"{i}.png", scene.camera, lambda: photo) for i in range(VIEWS))
    nowhere = np.zeros((0, 3), np.float32)
    dataset = sx.Dataset(photos, (), sx.PointCloud(nowhere, nowhere))
    recipe = with_views(sx.Recipe(steps=1_000_000, density=NoDensityControl(), sh=ShSchedule(3, 1)), views)
    count = len(scene.gaussians)
    start = jax.tree.map(jnp.copy, pad(scene.gaussians, bucket_for(count)))
    state = RunState(first_state(start, recipe, 1.0, VIEWS), count)
    return optimize(dataset, recipe, state, devices=None if devices is None else jax.devices()[:devices])


def timed(steps: Iterator[Progress]) -> tuple[float, float]:
    """Returns the seconds of the clock and of the processor that a step takes, a mean over a few."""
    wall, used = time.perf_counter(), time.process_time()
    for _ in range(AT_ONCE):
        progress = next(steps)
    progress.loss.block_until_ready()
    return (time.perf_counter() - wall) / AT_ONCE, (time.process_time() - used) / AT_ONCE


def quartiles(values: Sequence[float]) -> str:
    """Returns the median and the quartiles of values as text."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return f"{middle:.3f} ({low:.3f} to {high:.3f})"


def partly_seen(scene: Scene, seen: float) -> Scene:
    """Returns a scene of which the photos show a fraction; the rest is moved far aside."""
    hidden = np.random.default_rng(1).uniform(size=len(scene.gaussians)) >= seen
    means = scene.gaussians.means.at[:, 0].add(jnp.where(hidden, 1e3, 0.0))
    return replace(scene, gaussians=replace(scene.gaussians, means=means))


def main() -> None:
    """Times all ways in turn, and prints times of each and ratios of pairs."""
    given = sys.argv[1:]
    *sizes, seen = (*given, *DEFAULTS[len(given) :])
    count, width, height, rounds = map(int, sizes)
    scene = partly_seen(procedural(count, (width, height)), float(seen))
    runs = {name: steps_of(scene, *way) for name, way in WAYS.items()}
    for steps in runs.values():
        timed(steps)  # compiles
    times = np.array([[timed(steps) for steps in runs.values()] for _ in range(rounds)])
    print(f"{count:,} Gaussians, {width} x {height} pixels, {rounds} rounds")
    for name, (wall, used) in zip(runs, np.median(times, axis=0) * 1e3, strict=True):
        print(f"{name}: {wall:.1f} ms a step, {used:.1f} ms of CPU")
    order = list(runs)
    for one, other in PAIRS:
        wall, used = (times[:, order.index(one)] / times[:, order.index(other)]).T
        print(f"{one} / {other}: clock {quartiles(wall)}, CPU {quartiles(used)}")


if __name__ == "__main__":
    main()
