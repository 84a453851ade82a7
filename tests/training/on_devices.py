"""Trains a small capture on some of eight host devices and prints a digest; `test_devices.py` calls it.

It is a program of its own, because the number of devices is fixed when JAX starts.
"""

import argparse
import hashlib
import math
import re
from dataclasses import replace

parser = argparse.ArgumentParser()
parser.add_argument("recipe", choices=["default", "classic"])
parser.add_argument("--devices", type=int, nargs="+", default=[8], help="a run for each number")
parser.add_argument("--per-photo", action="store_true", help="with exposures, refined poses and weights")
parser.add_argument("--apart", action="store_true", help="with points that most photos do not show")
parser.add_argument("--packed", action="store_true", help="as devices that do not share their memory")
parser.add_argument("--geometry", action="store_true", help="with penalties on depths")
parser.add_argument("--bytes", action="store_true", help="print what a step exchanges instead of training")
parser.add_argument("--refinement", action="store_true", help="print what a refinement needs, likewise")
parser.add_argument("--resume", action="store_true", help="from half of the run on the devices before")
parser.add_argument("--host", type=int, nargs=3, metavar=("PORT", "COUNT", "INDEX"))
options = parser.parse_args()

import jax  # noqa: E402

jax.config.update("jax_num_cpu_devices", 8 if options.host is None else 8 // options.host[1])
if options.host is not None:
    port, count, index = options.host
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{port}", count, index)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from test_training import capture  # noqa: E402

import splatax as sx  # noqa: E402
from splatax import backends  # noqa: E402
from splatax.training import checkpoint, travel  # noqa: E402
from splatax.training.appearance import Exposure  # noqa: E402
from splatax.training.camera_refinement import Poses  # noqa: E402
from splatax.training.capacity import pad  # noqa: E402
from splatax.training.density import Classic  # noqa: E402
from splatax.training.density.growth import ByStep  # noqa: E402
from splatax.training.geometry import Surfaces  # noqa: E402
from splatax.training.loop import first_state  # noqa: E402
from splatax.training.photo_weights import RobustWeights  # noqa: E402
from splatax.training.protocols import DensityPlan  # noqa: E402
from splatax.training.recipes import ShSchedule, with_views  # noqa: E402
from splatax.training.refining import Kept, _on_devices, manner_of, sent  # noqa: E402
from splatax.training.schedule import Schedule  # noqa: E402
from splatax.training.steppers import stepper_for  # noqa: E402
from splatax.training.views import step_on_views  # noqa: E402

STEPS, VIEWS, ROWS = 8, 8, 16_384  # rows to count bytes for
POINTS, MOST = 7_680, 9_600  # each of eight devices owns living rows, and in the end one of them two blocks


def recipe() -> sx.Recipe:
    """A short run of eight views a step, with refinements."""
    made = sx.recipes.default(STEPS, max_gaussians=MOST)
    made = replace(made, density=replace(made.density, every=2, start=1, until=7, growth=ByStep(full=6)))
    if options.recipe == "classic":
        density = Classic(every=2, start=1, until=7, pull_threshold=1e-6, max_gaussians=MOST)
        made = sx.Recipe(steps=STEPS, density=density)
    if options.per_photo:
        weighed = replace(made.objective, weights=RobustWeights(since=0.25, least=1.02, spreads=0.1))
        made = replace(made, appearance=Exposure(), camera_refinement=Poses(), objective=weighed)
    if options.geometry:
        made = replace(made, objective=replace(made.objective, geometry=Surfaces(consistency=0.0, after=0.0)))
    return with_views(replace(made.on("cpu"), sh=ShSchedule(1, 2)), VIEWS)


def seen() -> sx.Dataset:
    """A capture with many points, whose photos note in `reads` that they are decoded."""
    dataset = capture(views=12)
    few, rng = dataset.points, np.random.default_rng(1)
    each = POINTS // len(few)
    near = rng.normal(scale=4.0 if options.apart else 0.1, size=(POINTS, 3)).astype(np.float32)
    points = sx.PointCloud(np.repeat(few.positions, each, 0) + near, np.repeat(few.colors, each, 0))

    def noted(view: sx.View) -> sx.View:
        def pixels():
            reads.append(view.name)
            return view.pixels()

        return replace(view, pixels=pixels)

    return replace(dataset, points=points, train=tuple(map(noted, dataset.train)))


def digest(state) -> str:
    """A digest of everything that a checkpoint of the run would hold."""
    found = hashlib.sha256()
    for name, array in sorted(checkpoint.take(state, {}, {}).arrays.items()):
        found.update(name.encode() + array.tobytes())
    return found.hexdigest()[:16]


def owners(progress) -> int:
    """Number of devices of this process that own living Gaussians."""
    shards = progress._state.gaussians.opacity_logits.addressable_shards
    return sum(bool(np.any(np.asarray(shard.data) > -np.inf)) for shard in shards)


def exchanged(number: int) -> list[int]:
    """Bytes that a device gets in a step, counted from the compiled program.

    Those of each part of the program that runs as a whole: of all steps first, then of all rows sent at once,
    there or back, and of one piece of them.
    """
    made = recipe().on(backends.resolve("cpu"))
    stepper = stepper_for(made, jax.devices()[:number])
    start = pad(made.initialization(dataset, 1, 0), ROWS)
    state = stepper.placed(first_state(start, made, 1.0, len(dataset.train)))
    views = next(stepper.feed(dataset.train, made, 0, Schedule(STEPS, STEPS, made.resolution), math.inf))
    openings = jnp.asarray(made.sh.openings(made.steps))
    arguments = state, views, made.optimizer.rates, openings, made, stepper.sharding.mesh
    text = step_on_views.lower(*arguments).compile().as_text()
    kinds = r"= (.*?) (?:all-to-all|all-gather|all-reduce|reduce-scatter|collective-permute)\("
    found = []
    for part in text.split("\n\n"):
        shapes = re.findall(r"(pred|[fsu]32)\[([\d,]*)\]", " ".join(re.findall(kinds, part)))
        total = sum(
            (1 if kind == "pred" else 4) * math.prod(int(n) for n in shape.split(",") if n)
            for kind, shape in shapes
        )
        found.append((part.startswith("ENTRY"), total))
    return [total for _, total in sorted(found, reverse=True) if total]


def held(number: int) -> int:
    """Bytes on each device while density control makes the new rows of a scene that doubles."""
    made = recipe().on(backends.resolve("cpu"))
    stepper = stepper_for(made, jax.devices()[:number])
    start = pad(made.initialization(dataset, 1, 0), ROWS)
    state = stepper.placed(first_state(start, made, 1.0, len(dataset.train)))
    parents = np.random.default_rng(0).permutation(np.arange(2 * ROWS) // 2)
    sides = np.ones(2 * ROWS, np.float32)
    plan = DensityPlan(parents, np.ones(2 * ROWS, bool), sides)
    kept = Kept(state.gaussians, state.opt_state, state.density_state)
    ways, new = sent(plan, ROWS, 2 * ROWS, stepper.sharding)
    program = _on_devices.lower(kept, ways, new, manner_of(plan, made), stepper.sharding.mesh).compile()
    found = program.memory_analysis()
    return found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes


def shown_in(scene: sx.Gaussians, camera: sx.Camera) -> float:
    """The fraction of a scene that a photo shows."""
    return float(np.mean(np.asarray(sx.project(scene, camera).extents)[:, 0] > 0))


if options.packed:
    travel.share_memory = lambda mesh: False
reads: list[str] = []
dataset, start = seen(), None
if options.bytes:
    for number in options.devices:
        print("run", number, *exchanged(number))
    raise SystemExit
if options.refinement:
    for number in options.devices:
        print("run", number, held(number))
    raise SystemExit
for number in options.devices:
    here = jax.devices()[:number]
    first, fewest = 0, number
    for progress in sx.optimize(dataset, recipe(), start, photo_room=0, devices=here):
        first, fewest = first or progress.count, min(fewest, owners(progress))
        if options.resume and start is None and progress.step == STEPS // 2:
            start = checkpoint.restore(checkpoint.take(progress.state, {}, {}), recipe())
            break
    else:
        same = digest(progress.state), float(progress.loss)
        print("shown", *(shown_in(progress.gaussians, view.camera) for view in dataset.train))
        print("run", number, first, progress.count, fewest, *same, flush=True)
print("read", *reads, flush=True)
