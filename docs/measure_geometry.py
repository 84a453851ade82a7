"""Compares penalties on geometry and on the scene by photos and points that were held out from training.

python docs/measure_geometry.py CAPTURES [VARIANTS [STEPS [DOWNSCALE [SEED [FIRST]]]]]
    CAPTURES    folders with commas; "demo" is the synthetic still life at its own size
    VARIANTS    names of `VARIANTS` with semicolons; "all", the default, stands for all of them
    STEPS       of each run, 500 by default
    DOWNSCALE   of the photos in folders, 4 by default
    SEED        of the runs, 0 by default
    FIRST       number of the first photo that is held out, 3 by default

Every sixth training photo and a fifth of the points are held out: runs start from the other points, and have
only these as landmarks. The capture's own held-out photos are not used. PSNR is the mean over the photos; in
brackets follow the median over them of the difference from the first variant, and the photo that loses most.
Errors and biases of depth are relative to the depth: medians over the held-out points of a held-out photo,
then means over photos. Where the truth is known, the errors and biases over all
pixels of these photos follow, in world units. The script prints a line for each run, for the tables of
docs/geometry.md.
"""

import sys
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

import splatax as sx
from splatax import backends
from splatax.cameras.geometry import seen_at
from splatax.dataset import Dataset, PointCloud, View
from splatax.geometry_scores import HALF, OF_PLANES, against_landmarks, depth_error, evaluate_geometry
from splatax.training.disc_geometry import DiscGeometry
from splatax.training.geometry import NoGeometry, Surfaces
from splatax.training.priors import Flatness, Priors, Sparsity
from splatax.training.recipes import Recipe, default, discs, room_for

DEFAULTS = "all", 500, 4, 0, 3  # variants, steps, downscale, seed and first photo
PHOTOS, POINTS = 6, 5  # one of so many is held out
COLORS = 3  # channels of a photo; penalties on geometry blend more

Variant = Callable[[int, int], Recipe]  # from the number of steps and the largest number of Gaussians


def of(build: Variant = default, **parts: Any) -> Variant:
    """Returns the variant of a recipe with other parts of its objective."""

    def variant(steps: int, most: int) -> Recipe:
        recipe = build(steps, most)
        return replace(recipe, objective=replace(recipe.objective, **parts))

    return variant


def weighed(
    spread: float,
    consistency: float,
    points: float,
    limit: float = Surfaces.consistency_limit,
    after: float = 0.0,
) -> Variant:
    """Returns `default` with penalties of these weights, and this limit of the consistency of normals."""
    return of(geometry=Surfaces(spread, consistency, points, consistency_limit=limit, after=after))


def depths(spread: float = 0.1, points: float = 0.6, **settings: float) -> Surfaces:
    """Returns penalties on depths alone, with the weights that `--geometry` had before it had normals."""
    return Surfaces(spread, 0.0, points, **{"after": 0.0, **settings})


def only(spread: float = 0.1, points: float = 0.6, **settings: float) -> Variant:
    """Returns `default` with penalties on depths alone."""
    return of(geometry=depths(spread, points, **settings))


def pulling(factor: float, variant: Variant) -> Variant:
    """Returns a variant whose penalties on geometry move opacities, places and sizes less.

    The gradient that passes through the splats of a view, and not through the planes, is multiplied by a
    factor.
    """

    def scaled(value: jax.Array) -> jax.Array:
        return factor * value + (1 - factor) * jax.lax.stop_gradient(value)

    def weaker(steps: int, most: int) -> Recipe:
        kernels = backends.resolve("auto")

        def composite(splats: sx.Splats, channels: jax.Array) -> tuple[jax.Array, jax.Array]:
            held = jax.tree.map(scaled, splats) if channels.shape[1] > COLORS else splats
            return kernels.composite(held, channels)

        return variant(steps, most).on(replace(kernels, name=f"pulling {factor}", composite=composite))

    return weaker


VARIANTS: dict[str, Variant] = {
    "default": default,
    "--geometry": of(geometry=Surfaces()),
    "0.06, 0.2, 0.9 after 0.4": weighed(0.06, 0.2, 0.9, after=0.4),
    "0.04, 0.15, 0.6 after 0.4": weighed(0.04, 0.15, 0.6, after=0.4),
    "0.025, 0.15, 0.8 after 0.4": weighed(0.025, 0.15, 0.8, after=0.4),
    "0.025, 0.1, 0.4 after 0.2": weighed(0.025, 0.1, 0.4, after=0.2),
    "0.025, 0.1, 0.4 after 0.4": weighed(0.025, 0.1, 0.4, after=0.4),
    "0.025, 0.1, 0.4": weighed(0.025, 0.1, 0.4),
    "0.05, 0.02, 0.3 without limit": weighed(0.05, 0.02, 0.3, inf),
    "0.05, 0.05, 0.3 within 0.05": weighed(0.05, 0.05, 0.3, 0.05),
    "0.05, 0.1, 0.3 within 0.05": weighed(0.05, 0.1, 0.3, 0.05),
    "0.025, 0.1, 0.3 within 0.05": weighed(0.025, 0.1, 0.3, 0.05),
    "0.025, 0.1, 0.15": weighed(0.025, 0.1, 0.15),
    "0.025, 0.1, 0.3": weighed(0.025, 0.1, 0.3),
    "0.025, 0.1, 0.6": weighed(0.025, 0.1, 0.6),
    "0.0125, 0.1, 0.3": weighed(0.0125, 0.1, 0.3),
    "0, 0.1, 0.3": weighed(0.0, 0.1, 0.3),
    "0.1, 0.6": only(),
    "0.1, 0.2 without limits": only(points=0.2, spread_limit=inf, points_limit=inf),
    "0.02, 0.02 without limits": only(0.02, 0.02, spread_limit=inf, points_limit=inf),
    "0.05, 0.3": only(0.05, 0.3),
    "spread only": only(points=0.0),
    "points only": only(spread=0.0),
    "splats x 0.3": pulling(0.3, only()),
    "planes only": pulling(0.0, only()),
    "opacity penalty 0": of(prior=Sparsity(opacity=0.0)),
    "opacity penalty 0.01": of(prior=Sparsity()),
    "opacity penalty 0.03": of(prior=Sparsity(opacity=0.03)),
    "opacity penalty negative": of(prior=Sparsity(opacity=-0.01)),
    "scale penalty 0": of(prior=Sparsity(scale=0.0)),
    "scale penalty x 3": of(prior=Sparsity(scale=0.03)),
    "flatness 0.1": of(prior=Priors((Sparsity(), Flatness(0.1)))),
    "flatness": of(prior=Priors((Sparsity(), Flatness()))),
    "flatness, opacity penalty 0": of(prior=Priors((Sparsity(opacity=0.0), Flatness()))),
    "0.1, 0.6, opacity penalty 0.01": of(only(), prior=Sparsity()),
    "0.1, 0.6, opacity penalty 0": of(only(), prior=Sparsity(opacity=0.0)),
    "0.1, 0.6, flatness": of(only(), prior=Priors((Sparsity(), Flatness()))),
    "2dgs": discs,
    "2dgs --geometry": of(discs, geometry=Surfaces()),
    "2dgs, 0.1, 0.6": of(discs, geometry=depths()),
    "2dgs without penalties": of(discs, geometry=NoGeometry()),
    "2dgs, distortion 0.03": of(discs, geometry=DiscGeometry(distortion=0.03)),
    "2dgs, distortion 0.3": of(discs, geometry=DiscGeometry(distortion=0.3)),
}


def main(
    captures: Sequence[str], names: Sequence[str], steps: int, downscale: int, seed: int, held_out: int
) -> None:
    for capture in captures:
        dataset = parted(
            sx.demo_dataset() if capture == "demo" else sx.load_dataset(capture, downscale=downscale),
            held_out,
        )
        first = None
        for name in names:
            recipe = replace(VARIANTS[name](steps, room_for(dataset)), seed=seed)
            began = time.process_time()
            scene = sx.fit(dataset, recipe)
            seconds = time.process_time() - began
            scored = sx.evaluate(scene, dataset.test, renderer=recipe.renderer)
            photos = np.array([view.psnr for view in scored.views])
            first = photos if first is None else first
            worst = int(np.argmin(photos - first))
            print(
                f"{Path(capture).name} | {name} | {photos.mean():.2f} dB "
                f"({np.median(photos - first):+.2f}; {scored.views[worst].name} {photos[worst]:.1f}, "
                f"{photos[worst] - first[worst]:+.1f}) | {scores(scene, dataset, recipe)} | "
                f"median opacity {np.median(scene.opacities):.2f} | {len(scene):,} Gaussians, "
                f"{seconds:.0f} s of CPU",
                flush=True,
            )


def parted(whole: Dataset, first: int = DEFAULTS[-1]) -> Dataset:
    """Returns a capture that has training photos and points held out for evaluation."""
    views = tuple(sorted(whole.train, key=lambda view: view.name))
    held_out = views[first - 1 :: PHOTOS]
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


def scores(scene: sx.Gaussians, dataset: Dataset, recipe: Recipe) -> str:
    """Returns the scores of a scene's geometry in words."""
    seen = against_landmarks(scene, dataset.test, recipe.renderer)
    assert seen, "no point is held out"
    biases = np.nanmean([biases_of(scene, view, recipe) for view in dataset.test], axis=0)
    columns = [
        f"{100 * seen.mean.depths[output].relative:.2f} %, {100 * bias:+.2f} %"
        for output, bias in zip(OF_PLANES, biases, strict=True)
    ]
    exact = evaluate_geometry(scene, dataset.test, renderer=recipe.renderer)
    if exact and exact.reference == "truth":
        depths = exact.mean.depths
        columns += [f"{depths[output].median:.4f}, {depths[output].bias:+.4f}" for output in OF_PLANES]
        columns += [f"{exact.mean.normals:.1f} degrees"]
    return " | ".join(columns)


def biases_of(scene: sx.Gaussians, view: View, recipe: Recipe) -> list[float]:
    """Returns the median relative error of each depth at the landmarks of a view, positive behind them."""
    assert view.landmarks
    camera = view.camera
    pixels, depths = seen_at(camera, view.landmarks().astype(np.float64))
    inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
    x, y = pixels[inside].astype(int).T
    images = recipe.renderer(scene, camera, ("alpha", *OF_PLANES)).images
    opaque = np.asarray(images["alpha"])[y, x] >= HALF
    found = [np.asarray(images[output])[y, x] / depths[inside] for output in OF_PLANES]
    return [depth_error(ratio[opaque], np.ones(int(opaque.sum()))).bias for ratio in found]


if __name__ == "__main__":
    asked, total, smaller, chance, start = (*sys.argv[2:], *DEFAULTS[len(sys.argv[2:]) :])
    named = list(VARIANTS) if asked == "all" else str(asked).split(";")
    if unknown := {*named} - {*VARIANTS}:
        sys.exit(f"no such variants: {', '.join(sorted(unknown))}. There are: {'; '.join(VARIANTS)}.")
    main(sys.argv[1].split(","), named, int(total), int(smaller), int(chance), int(start))
