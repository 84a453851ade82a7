"""Compares variants of `default` in long runs, scored on training photos that no run has seen.

python docs/measure_long.py CAPTURES SEEDS VARIANTS [STEPS [DOWNSCALE]]
    CAPTURES    folders with commas, or names of drawn scenes: demo, room, object, outdoor, thin, glossy
    SEEDS       whole numbers with commas
    VARIANTS    names of `VARIANTS` with commas; two joined by "+" are applied one after the other
    STEPS       of each run, 3,000 by default
    DOWNSCALE   of the photos, 2 by default; drawn photos have 320 x 240 pixels at 1

The number of Gaussians follows the number of pixels, as it does at full size, and so does the number of
points that runs start from. Every 8th training photo is held out, from the fifth; the capture's own held-out
photos are not used at all.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial, reduce

import splatax as sx
from splatax.dataset import Dataset, PointCloud
from splatax.demo.scenes import SCENES
from splatax.losses import Photometric
from splatax.training.appearance import Exposure
from splatax.training.density import Mcmc
from splatax.training.density.growth import ByStep
from splatax.training.density.splitting import Halves
from splatax.training.noise import Langevin
from splatax.training.optimizer import SceneExtent
from splatax.training.priors import Sparsity
from splatax.training.recipes import Recipe, ShSchedule, default, room_for
from splatax.training.resolution import Resolution

SIZE = (320, 240)
DEFAULTS = 3_000, 2  # steps and downscale
IMPROVED_GS = Halves(distance=1.35, along=0.55, across=0.893, opacity=0.6)  # of arXiv 2508.12313
Variant = Callable[[Recipe], Recipe]


def loaded(name: str, downscale: int) -> Dataset:
    """Returns a small capture whose held-out photos are training photos."""
    if name == "demo" or name in SCENES:
        drawn = sx.demo_dataset if name == "demo" else partial(sx.demo_dataset, scene=name)
        whole = drawn(width=SIZE[0] // downscale, height=SIZE[1] // downscale)
    else:
        whole = sx.load_dataset(name, downscale=downscale)
    views = tuple(sorted(whole.train, key=lambda view: view.name))
    held_out = views[4::8]
    return replace(
        whole,
        train=tuple(view for view in views if view not in held_out),
        test=held_out,
        points=PointCloud(whole.points.positions[:: downscale**2], whole.points.colors[:: downscale**2]),
    )


def rates(recipe: Recipe, **factors: float) -> Recipe:
    """Returns a recipe with learning rates multiplied by factors, by field."""
    given = recipe.optimizer.rates
    changed = replace(given, **{name: getattr(given, name) * by for name, by in factors.items()})
    return replace(recipe, optimizer=replace(recipe.optimizer, rates=changed))


def settling(recipe: Recipe, after: float, to: float) -> Recipe:
    """Returns a recipe whose learning rates fall in another part of the run."""
    changed = replace(recipe.optimizer.rates, settled=to, settling_from=after)
    return replace(recipe, optimizer=replace(recipe.optimizer, rates=changed))


def density(recipe: Recipe, **changes: object) -> Recipe:
    """Returns a recipe with other settings of the density strategy."""
    return replace(recipe, density=replace(recipe.density, **changes))


def copying(recipe: Recipe) -> Recipe:
    """Returns a recipe whose new Gaussians are copies drawn by opacity, at the same steps and as many."""
    old = recipe.density
    strategy = Mcmc(old.every, old.start, old.until, old.growth, old.min_opacity, old.max_gaussians)
    return replace(recipe, density=strategy)


def prior(recipe: Recipe, opacity: float, scale: float) -> Recipe:
    """Returns a recipe with other weights of the penalties."""
    return replace(recipe, objective=replace(recipe.objective, prior=Sparsity(opacity, scale)))


def noise(recipe: Recipe, strength: float) -> Recipe:
    """Returns a recipe with noise in the means."""
    return replace(recipe, optimizer=replace(recipe.optimizer, noise=Langevin(strength)))


VARIANTS: dict[str, Variant] = {
    "default": lambda r: r,
    "half the Gaussians": lambda r: density(r, max_gaussians=r.density.max_gaussians // 2),
    "4 x Gaussians": lambda r: density(r, max_gaussians=r.density.max_gaussians * 4),
    "2 x Gaussians": lambda r: density(r, max_gaussians=r.density.max_gaussians * 2),
    "means / 2": lambda r: rates(r, means=0.5, means_final=0.5),
    "means x 2": lambda r: rates(r, means=2, means_final=2),
    "means end x 5": lambda r: rates(r, means_final=5),
    "shapes / 2": lambda r: rates(r, log_scales=0.5, quats=0.5),
    "shapes x 2": lambda r: rates(r, log_scales=2, quats=2),
    "colours / 2": lambda r: rates(r, sh_dc=0.5, sh_rest=0.5),
    "bands / 2": lambda r: rates(r, sh_rest=0.5),
    "bands / 4": lambda r: rates(r, sh_rest=0.25),
    "bands x 2": lambda r: rates(r, sh_rest=2),
    "opacity / 2": lambda r: rates(r, opacity_logits=0.5),
    "opacity x 2": lambda r: rates(r, opacity_logits=2),
    "settling from 0.7": lambda r: settling(r, 0.7, 0.05),
    "settling to 0.01": lambda r: settling(r, 0.85, 0.01),
    "SSIM 0.1": lambda r: replace(r, objective=replace(r.objective, loss=Photometric(0.1))),
    "SSIM 0.4": lambda r: replace(r, objective=replace(r.objective, loss=Photometric(0.4))),
    "opacity penalty 0.03": lambda r: prior(r, 0.03, 0.01),
    "opacity penalty 0.01": lambda r: prior(r, 0.01, 0.01),
    "opacity penalty 0.003": lambda r: prior(r, 0.003, 0.01),
    "scale penalty x 10": lambda r: prior(r, 0.01, 0.1),
    "scale penalty x 3": lambda r: prior(r, 0.01, 0.03),
    "scale penalty / 3": lambda r: prior(r, 0.01, 0.003),
    "noise": lambda r: noise(r, 5e5),
    "noise / 4": lambda r: noise(r, 1.25e5),
    "copies": lambda r: copying(r),
    "hard halves": lambda r: density(r, halves=IMPROVED_GS),
    "parents at random": lambda r: density(r, focus=0.0),
    "steps in extents": lambda r: replace(r, optimizer=replace(r.optimizer, reach=SceneExtent())),
    "focus 1": lambda r: density(r, focus=1.0),
    "focus 2": lambda r: density(r, focus=2.0),
    "sizes without limit": lambda r: density(r, largest=math.inf),
    "sizes up to 1 / 4": lambda r: density(r, largest=0.25),
    "sizes up to 1": lambda r: density(r, largest=1.0),
    "splits until 0.5": lambda r: density(r, until=r.steps // 2),
    "grown at 0.2": lambda r: density(r, growth=ByStep(r.steps // 5)),
    "grown at 0.6": lambda r: density(r, growth=ByStep(3 * r.steps // 5)),
    "rarer refinements": lambda r: density(r, every=2 * r.density.every),
    "half size for a quarter": lambda r: replace(r, resolution=Resolution(((r.steps // 4, 2),), smallest=60)),
    "half size for a half": lambda r: replace(r, resolution=Resolution(((r.steps // 2, 2),), smallest=60)),
    "SH 2": lambda r: replace(r, sh=ShSchedule(2, r.sh.every)),
    "SH later": lambda r: replace(r, sh=ShSchedule(3, 3 * r.sh.every)),
    "exposure": lambda r: replace(r, appearance=Exposure()),
}


def varied(name: str, recipe: Recipe) -> Recipe:
    """Returns a recipe with the changes that a name stands for."""
    return reduce(lambda changed, part: VARIANTS[part](changed), name.split("+"), recipe)


def main(
    captures: Sequence[str], seeds: Sequence[int], variants: Sequence[str], steps: int, downscale: int
) -> None:
    """Prints a line for each run."""
    datasets = {capture: loaded(capture, downscale) for capture in captures}
    for seed in seeds:
        for variant in variants:
            for capture, dataset in datasets.items():
                recipe = varied(variant, replace(default(steps, room_for(dataset)), seed=seed))
                began = time.process_time()
                scene = sx.fit(dataset, recipe)
                seconds = time.process_time() - began
                score, known = (sx.evaluate(scene, views) for views in (dataset.test, dataset.train))
                print(
                    f"{capture.rsplit('/', 1)[-1]} seed {seed} {variant:24} {score.psnr:6.2f} dB "
                    f"{score.ssim:.4f} corrected {score.corrected_psnr:.2f} (training photos "
                    f"{known.psnr:.2f} dB), {len(scene):,} Gaussians, {seconds:.0f} s of CPU",
                    flush=True,
                )


if __name__ == "__main__":
    folders, numbers, names = (argument.split(",") for argument in sys.argv[1:4])
    total, smaller = map(int, (*sys.argv[4:], *DEFAULTS[len(sys.argv[4:]) :]))
    main(folders, [int(number) for number in numbers], names, total, smaller)
