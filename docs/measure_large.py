"""Measures large captures on synthetic ones: `python docs/measure_large.py decode|pairs|end|draw|train ...`.

decode FOLDER            reading a photo of 12 megapixels, through its lens and undistorted
pairs PHOTOS             choosing pairs of photos for matching, by synthetic features
end FOLDER VIEWS         the end of a run with so many test views of 504 x 378: scores, pictures and report
draw FOLDER PHOTOS       writes a capture of so many photos of 12 megapixels, of which 60 are distinct
train FOLDER [OPTIONS]   `splatax train FOLDER --memory 4GB --steps 40 OPTIONS`, and the peak of its memory

Times are those of the processor, of all threads together: two idle cores take at least half as long. If other
work runs beside it, set OPENBLAS_NUM_THREADS=1, because threads that wait for each other count too.
"""

import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from measure_blocks import city
from PIL import Image, ImageChops

import splatax as sx
from splatax.cameras import from_colmap
from splatax.evaluation import picture
from splatax.io.datasets import colmap_writing
from splatax.math import harmonics
from splatax.reconstruction.pairs import FEATURES, Similar, similar
from splatax.report.training import Pages
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.results import Results, conclude
from splatax.runs.session import Session

SIDES, LENS = (4000, 3000), (-0.12, 0.05, 0.001, -0.001)  # of photos, pixels; distortion of their camera
DISTINCT = 60  # photos that are drawn; a larger capture has several links to each
VIEW_SIZE = (504, 378)  # pixels of test views
TRAINED = 8  # photos beside the test views


@contextmanager
def measured(what: str) -> Iterator[None]:
    """Prints the processor time of what is done inside."""
    began, clock = time.process_time(), time.monotonic()
    yield
    seconds, wall = time.process_time() - began, time.monotonic() - clock
    print(f"{what}: {seconds:.2f} s of CPU ({wall:.1f} s of wall time)", flush=True)


def views_of_city(count: int, size: tuple[int, int], distortion: Sequence[float] = ()) -> list[sx.Camera]:
    """Returns cameras above the city that look at its streets and houses."""
    rng, found = np.random.default_rng(1), []
    width, height = size
    numbers = [0.7 * width, 0.7 * width, width / 2, height / 2, *distortion]
    for _ in range(count):
        eye = np.array([*rng.uniform(-4.5, 4.5, 2), rng.uniform(2.2, 2.8)])
        angle = np.arctan2(-eye[1], -eye[0]) + rng.uniform(-1.3, 1.3)  # not out of the city
        target = eye + (2 * np.cos(angle), 2 * np.sin(angle), -2.2)
        pose = sx.look_at(*(jnp.asarray(v, jnp.float32) for v in (eye, target, (0.0, 0, 1))))
        found.append(from_colmap("OPENCV" if distortion else "PINHOLE", numbers, width, height, pose))
    return found


def write_model(folder: Path, cameras: dict[str, sx.Camera], scene: sx.Gaussians, points: int) -> None:
    """Writes the cameras of a capture and some points of the scene."""
    views = [sx.View(name, camera, lambda: np.zeros((1, 1, 3), np.uint8)) for name, camera in cameras.items()]
    rows = np.sort(np.random.default_rng(2).choice(len(scene), points, replace=False))
    colors = np.clip(harmonics.to_rgb(np.asarray(scene.sh)[rows, 0]), 0, 1)
    colmap_writing.save(folder, views, sx.PointCloud(np.asarray(scene.means)[rows], colors))


@cache
def grain() -> Image.Image:
    """Returns noise around grey at 12 megapixels."""
    tile = np.random.default_rng(0).normal(128, 6, (500, 500, 1))
    return Image.fromarray(np.tile(tile, (SIDES[1] // 500, SIDES[0] // 500, 3)).astype(np.uint8))


def large_photo(small: Image.Image) -> Image.Image:
    """Returns a picture at 12 megapixels, with detail at the finest scale."""
    return ImageChops.add(small.resize(SIDES, Image.Resampling.BICUBIC), grain(), 1.0, -128)


def decode(folder: Path) -> None:
    """Prints the time of reading photos of two qualities, at the sizes that are trained with."""
    (folder / "images").mkdir(parents=True)
    scene = city()
    cameras = dict(zip(("fine.jpg", "plain.jpg"), views_of_city(2, SIDES, LENS), strict=True))
    write_model(folder, cameras, scene, 1_000)
    for (name, camera), quality in zip(cameras.items(), (88, 75), strict=True):
        drawn = Image.fromarray(picture(scene, camera.resized(500, 375)))
        large_photo(drawn).save(folder / "images" / name, quality=quality)
    for downscale in (3, 4, 2):
        for undistort in (False, True):
            dataset = sx.load_dataset(folder, downscale=downscale, undistort=undistort)
            for view in dataset.views:
                megabytes = (folder / "images" / view.name).stat().st_size / 1e6
                view.pixels()
                times = []
                for _ in range(5):
                    began = time.process_time()
                    shape = view.pixels().shape
                    times.append(time.process_time() - began)
                print(
                    f"JPEG of {megabytes:.1f} MB to {shape[1]} x {shape[0]}, "
                    f"{'undistorted' if undistort else 'with its lens'}: {np.median(times) * 1e3:.0f} ms"
                )


def features_of_a_loop(photos: int) -> list[np.ndarray]:
    """Returns features of photos along a loop, which share some with their neighbours; each is noisy."""
    rng = np.random.default_rng(0)
    world = rng.gamma(0.5, size=(20 * photos, 128)).astype(np.float32)
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    found = []
    for photo in range(photos):
        seen = (20 * photo + rng.choice(1_000, FEATURES, replace=False)) % len(world)
        noisy = world[seen] + rng.normal(0, 0.02, (FEATURES, 128)).astype(np.float32)
        found.append(noisy / np.linalg.norm(noisy, axis=1, keepdims=True))
    return found


def pairs(photos: int) -> None:
    """Prints the time of choosing pairs."""
    features = features_of_a_loop(photos)
    with measured(f"pairs of {photos:,} photos"):
        found = similar(features, Similar().neighbours)
    apart = np.array([min(j - i, photos - j + i) for i, j in found])
    print(f"{len(found):,} pairs, of which {np.mean(apart < 50):.2%} share a part of the loop")


def end(folder: Path, count: int) -> None:
    """Prints time and memory of the end of a run, and the size of its report."""
    capture, out = folder / "capture", folder / "run"
    scene = city()
    if not capture.exists():
        (capture / "images").mkdir(parents=True)
        cameras = {
            f"{i:05}.jpg": camera for i, camera in enumerate(views_of_city(count + TRAINED, VIEW_SIZE))
        }
        write_model(capture, cameras, scene, 60_000)
        for name, camera in cameras.items():
            Image.fromarray(picture(scene, camera)).save(capture / "images" / name, quality=92)
        (capture / "test.txt").write_text("\n".join([*cameras][TRAINED:]))
    dataset = sx.load_dataset(capture)
    recipe = sx.recipes.default(steps=2, max_gaussians=60_000)
    out.mkdir(exist_ok=True)
    with Checkpoints(out, {}) as checkpoints:
        run = Session(dataset, recipe, checkpoints)
        for _ in run.steps():
            pass
        results = Results("end", dataset, recipe, run.history, run.last, {}, out)
        before, done = memory(), threading.Event()
        peak = [before]

        def watch() -> None:
            while not done.wait(0.05):
                peak[0] = max(peak[0], memory())

        thread = threading.Thread(target=watch)
        thread.start()
        with measured(f"end of a run with {len(dataset.test)} test views"):
            conclude(results, checkpoints, Pages())
        done.set()
        thread.join()
    size = (out / "report.html").stat().st_size / 1e6
    print(f"report {size:.1f} MB, {(peak[0] - before) / 1e9:.2f} GB more memory than before")


def memory() -> int:
    """Returns the memory of this process, bytes (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def draw(folder: Path, count: int) -> None:
    """Writes a capture of photos of 12 megapixels, of 2 to 3 MB each."""
    (folder / "images").mkdir(parents=True)
    scene, distinct = city(), min(count, DISTINCT)
    drawn = views_of_city(distinct, SIDES)
    names = [f"{index:05}.jpg" for index in range(count)]
    write_model(folder, {name: drawn[i % distinct] for i, name in enumerate(names)}, scene, 60_000)
    for index, name in enumerate(names):
        path = folder / "images" / name
        if index < distinct:
            small = Image.fromarray(picture(scene, drawn[index].resized(500, 375)))
            large_photo(small).save(path, quality=75)
        else:
            os.link(folder / "images" / names[index % distinct], path)


def train(folder: Path, options: Sequence[str]) -> None:
    """Trains on a capture for a few steps with little memory."""
    fixed = ["--memory", "4GB", "--steps", "40", "--out", str(folder / "run")]
    command = [sys.executable, "-m", "splatax", "train", str(folder), *fixed, *options]
    subprocess.run(command, check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    peak = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    print(f"peak {peak / 1e9:.2f} GB, {used.ru_utime + used.ru_stime:.0f} s of CPU")


if __name__ == "__main__":
    what, *words = sys.argv[1:]
    if what == "decode":
        decode(Path(words[0]))
    elif what == "pairs":
        pairs(int(words[0]))
    elif what == "end":
        end(Path(words[0]), int(words[1]))
    elif what == "draw":
        draw(Path(words[0]), int(words[1]))
    else:
        train(Path(words[0]), words[1:])
