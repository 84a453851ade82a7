"""Compares ways to learn from several photos a step, at an equal number of photos.

python docs/measure_batches.py CAPTURE DOWNSCALE GAUSSIANS PHOTOS SEEDS VARIANTS
    SEEDS       whole numbers with commas
    VARIANTS    names of `VARIANTS` with commas; "one" has one photo a step, the others `VIEWS`

Scores are of training photos that no run has seen. The held-out photos of the capture are not looked at.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import splatax as sx
from splatax.dataset import Dataset
from splatax.training.optimizer import rates_for
from splatax.training.recipes import Recipe, default

VIEWS, EVERY = 8, 5  # photos a step; every 5th training photo is scored


def as_now(photos: int, gaussians: int, seed: int, power: float = 0.5) -> Recipe:
    """Returns the recipe as before: rates by a power of the number of views, all else by steps."""
    recipe = default(photos // VIEWS, gaussians, 1)
    rates = replace(
        rates_for(photos),
        settled=recipe.optimizer.rates.settled,
        settling_from=recipe.optimizer.rates.settling_from,
    )
    optimizer = replace(recipe.optimizer, rates=rates.times(VIEWS**power))
    return replace(recipe, views=VIEWS, optimizer=optimizer, seed=seed)


def betas(recipe: Recipe, first: bool = True) -> Recipe:
    """Returns a recipe whose Adam forgets as much a photo as with one photo a step (Grendel-GS)."""
    rule = recipe.optimizer.rule
    b1 = rule.b1**VIEWS if first else rule.b1
    rule = replace(rule, b1=b1, b2=rule.b2**VIEWS)
    return replace(recipe, optimizer=replace(recipe.optimizer, rule=rule))


def by_photos(recipe: Recipe, photos: int) -> Recipe:
    """Returns a recipe that refines the scene as often, by photos, as with one photo a step."""
    one = default(photos)
    density = replace(recipe.density, every=max(round(one.density.every / VIEWS), 1))
    return replace(recipe, density=density)


VARIANTS: dict[str, Callable[[int, int, int], Recipe]] = {
    "one": lambda p, n, s: replace(default(p, n, 1), seed=s),
    "now": as_now,
    "betas": lambda p, n, s: betas(as_now(p, n, s)),
    "b2": lambda p, n, s: betas(as_now(p, n, s), first=False),
    "photos": lambda p, n, s: by_photos(as_now(p, n, s), p),
    "betas+photos": lambda p, n, s: by_photos(betas(as_now(p, n, s)), p),
    "betas+0.65": lambda p, n, s: betas(as_now(p, n, s, 0.65)),
    "betas+0.8": lambda p, n, s: betas(as_now(p, n, s, 0.8)),
    "now+0.65": lambda p, n, s: as_now(p, n, s, 0.65),
    "b2+0.65": lambda p, n, s: betas(as_now(p, n, s, 0.65), first=False),
    "b2+0.75": lambda p, n, s: betas(as_now(p, n, s, 0.75), first=False),
    "b2+0.85": lambda p, n, s: betas(as_now(p, n, s, 0.85), first=False),
    "b2+1": lambda p, n, s: betas(as_now(p, n, s, 1.0), first=False),
}


def scored_on_training(dataset: Dataset) -> Dataset:
    """Returns a capture whose held-out photos are training photos."""
    views = sorted(dataset.train, key=lambda view: view.name)
    test = tuple(views[EVERY // 2 :: EVERY])
    names = {view.name for view in test}
    return replace(dataset, train=tuple(view for view in views if view.name not in names), test=test)


def main() -> None:
    """Trains all variants with all seeds, and prints the scores of each run."""
    capture, downscale, gaussians, photos, seeds, names = sys.argv[1:]
    dataset = scored_on_training(sx.load_dataset(capture, downscale=int(downscale)))
    found: dict[str, list[float]] = {}
    for seed in map(int, seeds.split(",")):
        for name in names.split(","):
            recipe = VARIANTS[name](int(photos), int(gaussians), seed)
            begin = time.process_time()
            for progress in sx.optimize(dataset, recipe):
                pass
            took = time.process_time() - begin
            scores = sx.evaluate(progress.gaussians, dataset.test, renderer=recipe.renderer)
            found.setdefault(name, []).append(scores.psnr)
            print(
                f"{name} seed {seed}: {scores.psnr:.2f} dB / {scores.ssim:.3f}, {recipe.steps} steps of "
                f"{recipe.views}, {len(progress.gaussians):,} Gaussians, {took:.0f} s of CPU",
                flush=True,
            )
    for name, each in found.items():
        print(f"{name}: {np.mean(each):.2f} dB (mean of {len(each)})")


if __name__ == "__main__":
    main()
