"""Measures and draws the geometry of trained scenes of the demo, beside the truth.

    splatax demo --out RUN                             and
    splatax train RUN/capture --out RUN2 --geometry
    python docs/make_geometry.py RUN/capture RUN RUN2

The script prints the table of docs/geometry.md, and writes docs/images/geometry.jpg: truth and runs from top
to bottom; colour, depth and normals from left to right.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatax as sx
from splatax.demo.raycast import truth
from splatax.demo.scenes import DEFAULT, scene_named
from splatax.report.pictures import depth_range, shaded

IMAGES = Path(__file__).parent / "images"
OUTPUTS = ("rgb", "alpha", "depth", "median_depth", "surface_depth", "median_surface_depth", "normals")
DEPTHS = OUTPUTS[2:6]


def main(capture: Path, runs: list[Path]) -> None:
    dataset = sx.load_dataset(capture)
    known = [truth(view.camera, scene_named(DEFAULT)) for view in dataset.test]
    limits = depth_range(np.asarray(known[0].depth), np.isfinite(known[0].depth))
    rows = [row(dataset.test[0].pixels(), known[0].depth, known[0].normals, limits)]
    for run in runs:
        scene = sx.load(run / "scene.ply")
        drawn = [sx.render(scene, view.camera, outputs=OUTPUTS) for view in dataset.test]
        print(f"{run.name}: {len(scene):,} Gaussians, PSNR {sx.evaluate(scene, dataset.test).psnr:.2f} dB")
        print(f"  median opacity {np.median(scene.opacities):.2f}")
        for depth in DEPTHS:
            print(f"  {depth}: " + in_words(depth, drawn, known))
        print(f"  normals: {np.median(angles(drawn, known)):.1f} degrees")
        first = drawn[0]
        colors = np.round(255 * np.clip(first.rgb, 0, 1)).astype(np.uint8)
        rows.append(row(colors, first.surface_depth, first.normals, limits))
    IMAGES.mkdir(exist_ok=True)
    Image.fromarray(np.concatenate(rows)).resize((960, 240 * len(rows)), Image.Resampling.NEAREST).save(
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
    main(Path(sys.argv[1]), [Path(run) for run in sys.argv[2:]])
