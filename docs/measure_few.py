"""Compares variants of `default` on captures of few photos, scored on training photos that were held out.

python docs/measure_few.py CAPTURES SEEDS VARIANTS
    CAPTURES    folders with commas; "demo" is the synthetic still life
    SEEDS       whole numbers with commas
    VARIANTS    names of `VARIANTS` with commas

Each run trains on a few photos, spread evenly over a capture, from the points that two of them observe.
"""

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import splatax as sx
from splatax.dataset import Dataset, PointCloud, View
from splatax.training.geometry import Surfaces
from splatax.training.objectives import Geometry, Prior
from splatax.training.priors import Sparsity
from splatax.training.recipes import Recipe, ShSchedule, default, room_for

PHOTOS, SCORED, STEPS, DOWNSCALE = 10, 8, 400, 4


def spread(views: Sequence[View], count: int) -> tuple[View, ...]:
    """Returns views spread evenly over others."""
    return tuple(views[i] for i in np.round(np.linspace(0, len(views) - 1, count)).astype(int))


def few(capture: str) -> Dataset:
    """Returns a capture with few of its training photos, and others of them to score on."""
    if capture == "demo":
        whole = sx.demo_dataset(width=160, height=120)
    else:
        whole = sx.load_dataset(capture, downscale=DOWNSCALE)
    views = sorted(whole.train, key=lambda view: view.name)
    train = spread(views, min(PHOTOS, (len(views) + 1) // 2))
    used = {view.name for view in train}
    others = [view for view in views if view.name not in used]
    return replace(
        whole,
        train=train,
        test=spread(others, min(SCORED, len(others))),
        points=observed(whole.points, train),
    )


def observed(points: PointCloud, views: Sequence[View]) -> PointCloud:
    """Returns the points that at least two views observe, as few photos would have found no others."""
    times: Counter[bytes] = Counter()
    for view in views:
        assert view.landmarks
        times.update(row.tobytes() for row in np.unique(np.asarray(view.landmarks(), np.float32), axis=0))
    kept = np.array([times[row.tobytes()] > 1 for row in np.asarray(points.positions, np.float32)])
    return PointCloud(points.positions[kept], points.colors[kept])


def with_prior(recipe: Recipe, prior: Prior) -> Recipe:
    """Returns a recipe with another prior."""
    return replace(recipe, objective=replace(recipe.objective, prior=prior))


def with_geometry(recipe: Recipe, geometry: Geometry) -> Recipe:
    """Returns a recipe with a penalty on geometry."""
    return replace(recipe, objective=replace(recipe.objective, geometry=geometry))


VARIANTS: dict[str, Callable[[int], Recipe]] = {
    "default": lambda most: default(STEPS, most),
    "half the Gaussians": lambda most: default(STEPS, most // 2),
    "a quarter": lambda most: default(STEPS, most // 4),
    "points": lambda most: with_geometry(default(STEPS, most), Surfaces(0.0, 0.0, 0.2, after=0.0)),
    "points a little": lambda most: with_geometry(default(STEPS, most), Surfaces(0.0, 0.0, 0.05, after=0.0)),
    "geometry": lambda most: with_geometry(default(STEPS, most), Surfaces()),
    "priors x 4": lambda most: with_prior(default(STEPS, most), Sparsity(opacity=0.04, scale=0.04)),
    "SH 1": lambda most: replace(default(STEPS, most), sh=ShSchedule(1, STEPS // 20)),
    "SH 0": lambda most: replace(default(STEPS, most), sh=ShSchedule(0, STEPS // 20)),
}


def main(captures: Sequence[str], seeds: Sequence[int], variants: Sequence[str]) -> None:
    """Prints a line for each run."""
    datasets = {capture: few(capture) for capture in captures}
    for seed in seeds:
        for variant in variants:
            for capture, dataset in datasets.items():
                recipe = replace(VARIANTS[variant](room_for(dataset)), seed=seed)
                began = time.process_time()
                scene = sx.fit(dataset, recipe)
                seconds = time.process_time() - began
                score = sx.evaluate(scene, dataset.test)
                known = sx.evaluate(scene, dataset.train)
                print(
                    f"{capture} seed {seed} {variant:20} {score.psnr:6.2f} dB {score.ssim:.4f} "
                    f"(training photos {known.psnr:.2f} dB), {seconds:.0f} s of CPU",
                    flush=True,
                )


if __name__ == "__main__":
    names, numbers, wanted = (argument.split(",") for argument in sys.argv[1:4])
    main(names, [int(number) for number in numbers], wanted)
