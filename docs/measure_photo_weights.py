"""Measures the effect of robust weights of photos, on captures as they are and with two outliers.

python docs/measure_photo_weights.py CAPTURES STEPS
    CAPTURES    folders with commas, or names of synthetic scenes: demo, room, object, outdoor, thin, glossy
    STEPS       of each run

One training photo is replaced by another one, as if its pose were wrong. In another, a dark disc covers the
lower half, as a thumb over the lens would. Scores are of the held-out photos, which are unchanged.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

import splatax as sx
from splatax.dataset import Dataset, Pixels
from splatax.demo.scenes import SCENES
from splatax.training.loop import optimize
from splatax.training.photo_weights import PHOTO_WEIGHTS
from splatax.training.recipes import default, room_for

MOST, DOWNSCALE, SIZE = 6_000, 4, (120, 90)


def loaded(name: str) -> Dataset:
    """Returns a small capture."""
    if name == "demo" or name in SCENES:
        drawn = sx.demo_dataset if name == "demo" else partial(sx.demo_dataset, scene=name)
        return drawn(width=SIZE[0], height=SIZE[1])
    return sx.load_dataset(name, downscale=DOWNSCALE)


def covered(pixels: Callable[[], Pixels]) -> Pixels:
    """Returns a photo with a dark disc over its lower half."""
    photo = pixels().copy()
    height, width = photo.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    photo[np.hypot(rows - 0.9 * height, columns - 0.6 * width) < 0.6 * height, :3] = 40
    return photo


def spoiled(dataset: Dataset) -> Dataset:
    """Returns the capture with two wrong training photos."""
    views = list(dataset.train)
    wrong, other, thumb = len(views) // 3, 2 * len(views) // 3, len(views) // 2
    views[thumb] = replace(views[thumb], pixels=partial(covered, views[thumb].pixels))
    views[wrong] = replace(views[wrong], pixels=views[other].pixels)
    return replace(dataset, train=tuple(views))


def main(names: list[str], steps: int) -> None:
    """Prints a line for each run."""
    for name in names:
        clean = loaded(name)
        for kind, dataset in (("as it is", clean), ("two wrong", spoiled(clean))):
            for weighing, weights in PHOTO_WEIGHTS.items():
                recipe = default(steps, min(room_for(dataset), MOST))
                recipe = replace(recipe, objective=replace(recipe.objective, weights=weights))
                began = time.process_time()
                for progress in optimize(dataset, recipe):
                    pass
                seconds = time.process_time() - began
                state, count = progress.state.train, len(dataset.train)
                low = np.asarray(weights.of_photos(state.weights, count, state.step / state.total))
                doubted = {dataset.train[i].name: round(float(low[i]), 3) for i in np.flatnonzero(low < 1)}
                score = sx.evaluate(progress.gaussians, dataset.test)
                print(
                    f"{name} {kind:9} {weighing:6} {score.psnr:6.2f} dB {score.ssim:.4f} {seconds:4.0f} s "
                    f"of CPU {doubted or ''}",
                    flush=True,
                )


if __name__ == "__main__":
    main(sys.argv[1].split(","), int(sys.argv[2]))
