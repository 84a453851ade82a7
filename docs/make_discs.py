"""Measures discs beside the other recipes: PSNR and geometry on held-out photos of the demo and of captures.

    python docs/make_discs.py STEPS [CAPTURE ...]

A capture is "demo" or a folder, whose photos are used at a quarter of their size. The script prints rows of
the table in docs/geometry.md.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import splatax as sx
from splatax.geometry_scores import evaluate_geometry
from splatax.training.geometry import Surfaces
from splatax.training.recipes import Recipe, room_for

QUARTER = 4
DEPTHS = ("surface_depth", "median_surface_depth")


def main(steps: int, captures: list[str]) -> None:
    for name in captures:
        dataset = sx.demo_dataset() if name == "demo" else sx.load_dataset(name, downscale=QUARTER)
        for title, recipe in recipes(steps, room_for(dataset)).items():
            used = time.process_time()
            scene = sx.fit(dataset, recipe)
            used = time.process_time() - used
            psnr = sx.evaluate(scene, dataset.test, renderer=recipe.renderer).psnr
            scores = evaluate_geometry(scene, dataset.test, renderer=recipe.renderer)
            assert scores is not None, f"{name} has neither truth nor points"
            mean = scores.mean
            depths = ", ".join(f"{output} {in_words(mean.depths[output])}" for output in DEPTHS)
            normals = "" if mean.normals is None else f", normals {mean.normals:.1f} degrees"
            print(
                f"{Path(name).name} {title}: {psnr:.2f} dB, {depths}{normals}, {len(scene):,} Gaussians, "
                f"median opacity {np.median(scene.opacities):.2f}, {used:.0f} s of CPU time",
                flush=True,
            )


def recipes(steps: int, most: int) -> dict[str, Recipe]:
    """Returns the recipes to compare, by their names in the table."""
    default, discs = sx.recipes.default(steps, most), sx.recipes.discs(steps, most)
    return {
        "2dgs": discs,
        "2dgs --geometry": with_surfaces(discs),
        "default": default,
        "--geometry": with_surfaces(default),
    }


def with_surfaces(recipe: Recipe) -> Recipe:
    """Returns a recipe with the penalties of `--geometry` in place of its own."""
    return replace(recipe, objective=replace(recipe.objective, geometry=Surfaces()))


def in_words(error) -> str:
    """Returns the median error, its bias and the median relative error."""
    return f"{error.median:.4f} (bias {error.bias:+.4f}, {100 * error.relative:.2f} %)"


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
