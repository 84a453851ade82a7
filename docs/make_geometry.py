"""Measures and draws the geometry of the demo scene, with and without regularizers, beside the truth.

    python docs/make_geometry.py [STEPS]

The script trains both scenes, prints the table of docs/geometry.md, and writes docs/images/geometry.jpg:
truth, `default` and `default` with surfaces from top to bottom; colour, depth and normals from left to right.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatax as sx
from splatax.demo.raycast import truth
from splatax.demo.scenes import DEFAULT, scene_named
from splatax.report.pictures import depth_range, shaded
from splatax.training.geometry import Surfaces
from splatax.training.recipes import room_for

IMAGES = Path(__file__).parent / "images"
OUTPUTS = ("rgb", "alpha", "depth", "median_depth", "surface_depth", "median_surface_depth", "normals")
DEPTHS = OUTPUTS[2:6]


def main(steps: int) -> None:
    dataset = sx.demo_dataset()
    plain = sx.recipes.default(steps=steps, max_gaussians=room_for(dataset))
    surfaces = replace(plain, objective=replace(plain.objective, geometry=Surfaces()))
    known = [truth(view.camera, scene_named(DEFAULT)) for view in dataset.test]
    limits = depth_range(np.asarray(known[0].depth), np.isfinite(known[0].depth))
    rows = [row(dataset.test[0].pixels(), known[0].depth, known[0].normals, limits)]
    for name, recipe in (("default", plain), ("geometry", surfaces)):
        began, used = time.monotonic(), time.process_time()
        scene = sx.fit(dataset, recipe)
        wall, cpu = time.monotonic() - began, time.process_time() - used
        drawn = [sx.render(scene, view.camera, outputs=OUTPUTS) for view in dataset.test]
        print(f"{name}: {wall:.0f} s, {cpu:.0f} s of CPU time, {len(scene):,} Gaussians")
        print(f"  PSNR {sx.evaluate(scene, dataset.test, renderer=recipe.renderer).psnr:.2f} dB")
        print(f"  median opacity {np.median(scene.opacities):.2f}")
        for depth in DEPTHS:
            print(f"  {depth}: " + in_words(depth, drawn, known))
        print(f"  normals: {np.median(angles(drawn, known)):.1f} degrees")
        first = drawn[0]
        colors = np.round(255 * np.clip(first.rgb, 0, 1)).astype(np.uint8)
        rows.append(row(colors, first.surface_depth, first.normals, limits))
    IMAGES.mkdir(exist_ok=True)
    Image.fromarray(np.concatenate(rows)).resize((960, 720), Image.Resampling.NEAREST).save(
        IMAGES / "geometry.jpg", quality=85
    )


def in_words(output: str, drawn: list[sx.Rendering], known: list) -> str:
    """Returns the median error, the bias and the 90th percentile of a depth, over all views."""
    errors = []
    for view, there in zip(drawn, known, strict=True):
        depth = np.asarray(getattr(view, output))
        counts = np.isfinite(there.depth) & (depth > 0)
        errors.append((depth - np.asarray(there.depth))[counts])
    every = np.concatenate(errors)
    size = np.abs(every)
    return f"{np.median(size):.4f}, bias {np.median(every):+.4f}, 90 % {np.percentile(size, 90):.3f}"


def angles(drawn: list[sx.Rendering], known: list) -> np.ndarray:
    """Returns the angles between drawn and true normals, degrees, at all pixels that show a surface."""
    found = []
    for view, there in zip(drawn, known, strict=True):
        cosine = np.sum(np.asarray(view.normals) * np.asarray(there.normals), axis=-1)
        found.append(np.degrees(np.arccos(np.clip(cosine, -1, 1)))[np.isfinite(there.depth)])
    return np.concatenate(found)


def row(
    colors: np.ndarray, depth: jnp.ndarray, normals: jnp.ndarray, limits: tuple[float, float] | None
) -> np.ndarray:
    """Returns colour, depth and normals side by side; a normal n has the colour (1 + n) / 2."""
    near = shaded(np.asarray(depth), np.isfinite(depth) & (np.asarray(depth) > 0), limits)
    shades = np.round(255 * (1 + np.asarray(normals)) / 2).astype(np.uint8)
    return np.concatenate([np.asarray(colors)[..., :3], near, shades], axis=1)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2_000)
