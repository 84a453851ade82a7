"""Compares weights of `--geometry` by photos and points that were held out from training.

python docs/measure_geometry.py CAPTURES [WEIGHTS [STEPS [DOWNSCALE [SEED]]]]
    CAPTURES    folders with commas; "demo" is the synthetic still life at its own size
    WEIGHTS     names of `WEIGHTS` with semicolons; "all", the default, stands for all of them
    STEPS       of each run, 500 by default
    DOWNSCALE   of the photos in folders, 4 by default
    SEED        of the runs, 0 by default

Every sixth training photo, from the third, and a fifth of the points are held out: runs start from the
other points, and have only these as landmarks. The capture's own held-out photos are not used. PSNR is the
mean over the photos, with the median over them of the difference from the first weights. Errors of depth
are relative to the depth: medians over the held-out points of a held-out photo, then means over photos.
Where the truth is known, the errors over all pixels of these photos follow, in world units. The script
prints a line for each run, for the tables of docs/geometry.md.
"""

import sys
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

import splatax as sx
from splatax.dataset import Dataset, PointCloud, View
from splatax.geometry_scores import OF_PLANES, against_landmarks, evaluate_geometry
from splatax.training.geometry import NoGeometry, Surfaces
from splatax.training.recipes import default, room_for

DEFAULTS = "all", 500, 4, 0  # weights, steps, downscale and seed
PHOTOS, POINTS = 6, 5  # one of so many is held out
WEIGHTS = {
    "default": NoGeometry(),
    "--geometry": Surfaces(),
    "0.1, 0.2 without limits": Surfaces(points=0.2, spread_limit=inf, points_limit=inf),
    "0.02, 0.02 without limits": Surfaces(0.02, points=0.02, spread_limit=inf, points_limit=inf),
    "0.1, 0.2": Surfaces(points=0.2, points_limit=0.02),
    "0.05, 0.4": Surfaces(0.05, points=0.4, points_limit=0.02),
    "0.1, 0.4": Surfaces(points=0.4, points_limit=0.02),
    "0.1, 0.8": Surfaces(points=0.8, points_limit=0.02),
    "half": Surfaces(0.05, points=0.3),
    "quarter": Surfaces(0.025, points=0.15),
    "--geometry-after 0.2": Surfaces(after=0.2),
    "--geometry-after 0.4": Surfaces(after=0.4),
    "spread only": Surfaces(points=0.0),
    "points only": Surfaces(spread=0.0),
}


def main(captures: Sequence[str], names: Sequence[str], steps: int, downscale: int, seed: int) -> None:
    for capture in captures:
        dataset = parted(
            sx.demo_dataset() if capture == "demo" else sx.load_dataset(capture, downscale=downscale)
        )
        plain = replace(default(steps, room_for(dataset)), seed=seed)
        first = None
        for name in names:
            recipe = replace(plain, objective=replace(plain.objective, geometry=WEIGHTS[name]))
            began = time.process_time()
            scene = sx.fit(dataset, recipe)
            seconds = time.process_time() - began
            photos = np.array([view.psnr for view in sx.evaluate(scene, dataset.test).views])
            first = photos if first is None else first
            print(
                f"{Path(capture).name} | {name} | {photos.mean():.2f} dB "
                f"({np.median(photos - first):+.2f}) | {scores(scene, dataset)} | {len(scene):,} Gaussians, "
                f"{seconds:.0f} s of CPU",
                flush=True,
            )


def parted(whole: Dataset) -> Dataset:
    """Returns a capture that has training photos and points held out for evaluation."""
    views = tuple(sorted(whole.train, key=lambda view: view.name))
    held_out = views[PHOTOS // 2 - 1 :: PHOTOS]
    kept = ~chosen(whole.points.positions)
    return replace(
        whole,
        train=tuple(observing(view, held_out=False) for view in views if view not in held_out),
        test=tuple(observing(view, held_out=True) for view in held_out),
        points=PointCloud(whole.points.positions[kept], whole.points.colors[kept]),
    )


def observing(view: View, held_out: bool) -> View:
    """Returns a view whose landmarks are the points that are held out, or the others."""
    return replace(view, landmarks=view.landmarks and partial(landmarks_of, view.landmarks, held_out))


def landmarks_of(read: Callable[[], Float[np.ndarray, "n 3"]], held_out: bool) -> Float[np.ndarray, "m 3"]:
    """Returns the landmarks that are held out, or the others."""
    points = read()
    return points[chosen(points) == held_out]


def chosen(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Returns which points are held out. It depends on their positions, so all photos agree on it."""
    rows = np.ascontiguousarray(points, np.float32)
    return np.array([zlib.crc32(row.tobytes()) % POINTS == 0 for row in rows], bool)


def scores(scene: sx.Gaussians, dataset: Dataset) -> str:
    """Returns the scores of a scene's geometry in words."""
    seen = against_landmarks(scene, dataset.test)
    assert seen, "no point is held out"
    columns = [f"{100 * seen.mean.depths[output].relative:.2f} %" for output in OF_PLANES]
    exact = evaluate_geometry(scene, dataset.test)
    if exact and exact.reference == "truth":
        depths = exact.mean.depths
        columns += [f"{depths[output].median:.4f}, {depths[output].bias:+.4f}" for output in OF_PLANES]
        columns += [f"{exact.mean.normals:.1f} degrees"]
    return " | ".join(columns)


if __name__ == "__main__":
    asked, total, smaller, chance = (*sys.argv[2:], *DEFAULTS[len(sys.argv[2:]) :])
    named = list(WEIGHTS) if asked == "all" else str(asked).split(";")
    if unknown := {*named} - {*WEIGHTS}:
        sys.exit(f"no such weights: {', '.join(sorted(unknown))}. There are: {'; '.join(WEIGHTS)}.")
    main(sys.argv[1].split(","), named, int(total), int(smaller), int(chance))
