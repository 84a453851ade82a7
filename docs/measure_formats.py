"""Measures the tables of docs/formats.md: file sizes, times, and PSNR of renderings after a round trip.

python docs/measure_formats.py SCENE [--degree 3] [--views 6] [--capture FOLDER]

--degree adds synthetic harmonics, which vary over space, to a scene that has none. The views are the test
views of --capture or, by default, views from around the scene.
"""

import argparse
import tempfile
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import splatax as sx
from splatax.io import formats
from splatax.math import harmonics
from splatax.metrics import psnr, to_8bit

SIZE, FOCAL = (800, 600), 900.0


def orbit(gaussians: sx.Gaussians, views: int) -> list[sx.Camera]:
    """Returns cameras around the centre of a scene, slightly above it, that see most of it."""
    means = np.asarray(gaussians.means)
    low, high = np.quantile(means, [0.05, 0.95], axis=0)
    centre, radius = (low + high) / 2, 1.6 * float(np.linalg.norm(high - low))
    cameras = []
    for angle in 2 * np.pi * np.arange(views) / views:
        offset = radius * np.array([np.cos(angle), -0.35, np.sin(angle)])
        vectors = (jnp.asarray(v, jnp.float32) for v in (centre + offset, centre, (0, -1, 0)))
        cameras.append(sx.Camera.simple_pinhole(FOCAL, sx.look_at(*vectors), *SIZE))
    return cameras


def with_harmonics(gaussians: sx.Gaussians, degree: int) -> sx.Gaussians:
    """Adds synthetic view dependence: smooth over space, weaker in higher bands, with some noise."""
    rng = np.random.default_rng(0)
    means = np.asarray(gaussians.means)
    waves = np.sin(means[:, None] * np.array([1.0, 3.0, 9.0])[:, None]).reshape(len(means), 9)
    parts = [np.asarray(gaussians.sh[:, :1])]
    for band in range(1, degree + 1):
        shape = (2 * band + 1, 3)
        smooth = np.einsum("nw,wkc->nkc", waves, rng.normal(size=(9, *shape)))
        parts.append(0.05 / band * (smooth + 0.5 * rng.normal(size=(len(means), *shape))))
    sh = np.concatenate(parts, axis=1).astype(np.float32)
    return sx.Gaussians(
        gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits, jnp.asarray(sh)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--degree", type=int, default=0)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--capture", type=Path)
    options = parser.parse_args()
    gaussians = sx.load(options.scene)
    if options.degree:
        gaussians = with_harmonics(gaussians, options.degree)
    if options.capture:
        cameras = [view.camera for view in sx.load_dataset(options.capture).test]
    else:
        cameras = orbit(gaussians, options.views)

    def pictures(scene: sx.Gaussians) -> list[np.ndarray]:
        return [to_8bit(np.asarray(sx.render(scene, camera).rgb)) for camera in cameras]

    expected = pictures(gaussians)
    degree = harmonics.degree_of(gaussians.sh.shape[1])
    print(f"{len(gaussians):,} Gaussians, SH degree {degree}, {len(cameras)} views")
    print("| suffix | MB | save, s | load, s | PSNR, dB |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for suffix in formats.WRITTEN:
            path = Path(folder) / f"scene{suffix}"
            started = time.perf_counter()
            sx.save(path, gaussians)
            saved = time.perf_counter()
            loaded = sx.load(path)
            done = time.perf_counter()
            scores = [psnr(a, b) for a, b in zip(pictures(loaded), expected, strict=True)]
            times = f"{saved - started:.1f} | {done - saved:.1f}"
            print(
                f"| `{suffix}` | {path.stat().st_size / 1e6:.2f} | {times} | {np.mean(scores):.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
