"""Measures how fast pages open: `python docs/measure_pages.py SCENE.spz [ROUNDS]`, for example biker.spz.

The splat file gives scenes of 150,000 and of a million Gaussians: its first ones, and each of them split into
six or seven smaller ones at random places inside it. Their pages are opened alternately, each time in a fresh
headless Chromium, which draws in software in a window of 1280 x 720 pixels. The page itself notes the times
since its navigation: when its viewer starts, when the first splats are decoded, when the first picture is
drawn (`opened`) and when the picture of the whole scene is final (`complete`). The script prints medians of
these wall times and of the CPU times of all processes of the browser until then, which a busy machine changes
less, and the PSNR between the final picture and `render`.
"""

import io
import os
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image
from playwright.sync_api import Playwright, sync_playwright

import splatax as sx
from splatax import web
from splatax.math import harmonics
from splatax.trajectories import overview

SIZES = (150_000, 1_000_000)
WINDOW = (1280, 720)
HARMONICS = 0.03  # standard deviation of the coefficients of degree 1 to 3, as trained on fern
MARKS = ("viewer", "loaded", "opened", "complete")
FLAGS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
PATIENCE = 600  # seconds
TELL = "performance.getEntriesByType('mark').map(mark => [mark.name, mark.startTime / 1000])"


def of_size(gaussians: sx.Gaussians, count: int, degree: int) -> sx.Gaussians:
    """Returns `count` Gaussians, with new harmonics: the first, or all of them split."""
    rng = np.random.default_rng(0)
    rows = np.arange(count) * len(gaussians) // count if count > len(gaussians) else np.arange(count)
    pieces = max(count / len(gaussians), 1)
    means, quats, log_scales, logits = (
        np.asarray(field)[rows]
        for field in (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits)
    )
    if pieces > 1:
        w, *axis = quats.T / np.linalg.norm(quats, axis=1)
        axis, inside = np.stack(axis, 1), rng.normal(size=means.shape) * 0.8 * np.exp(log_scales)
        turned = 2 * np.cross(axis, np.cross(axis, inside) + w[:, None] * inside)  # v + 2 q x (q x v + w v)
        means, log_scales = means + inside + turned, log_scales - np.log(pieces) / 3
    sh = rng.normal(size=(count, harmonics.count(degree), 3)) * HARMONICS
    sh[:, 0] = np.asarray(gaussians.sh)[rows, 0]
    fields = (means, quats, log_scales, logits, sh)
    return replace(gaussians, **dict(zip(FIELDS, (jnp.asarray(f, jnp.float32) for f in fields), strict=True)))


FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def spent() -> float:
    """Returns the CPU time of the processes that this one has started, seconds."""
    rows = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended
        rows[int(folder.name)] = int(fields[1]), sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    family = {os.getpid()}
    while more := {process for process, (parent, _) in rows.items() if parent in family} - family:
        family |= more
    return sum(rows[process][1] for process in family - {os.getpid()})


def opened(
    playwright: Playwright, page: Path, last: str = "complete"
) -> tuple[dict[str, float], np.ndarray, int]:
    """Opens a page until its last mark.

    Returns:
        Wall and CPU times of its marks, seconds; its picture; and the number of splats in it.
    """
    path = os.environ.get("SPLATAX_CHROMIUM") or shutil.which("chromium")
    browser = playwright.chromium.launch(executable_path=path, args=[*FLAGS])
    tab = browser.new_page(viewport=dict(zip(("width", "height"), WINDOW, strict=True)))
    began, end, times = spent(), time.monotonic() + PATIENCE, {}
    tab.goto(page.as_uri(), wait_until="commit")
    while last not in times:
        assert time.monotonic() < end, f"{page.name} did not open"
        time.sleep(0.02)
        for name, wall in tab.evaluate(TELL):
            times.setdefault(name, wall)
            times.setdefault(f"CPU {name}", spent() - began)
    drawn = tab.evaluate("viewer.stage.spark.display.numSplats")
    tab.evaluate("document.body.classList.add('bare')")
    with Image.open(io.BytesIO(tab.screenshot())) as image:
        picture = np.asarray(image.convert("RGB"), np.float32) / 255
    browser.close()
    return times, picture, drawn


def main(path: str, rounds: int = 5) -> None:
    gaussians = sx.load(path)
    camera = overview(np.asarray(gaussians.means), WINDOW)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        for degree in (0, 3):
            pages, pictures = {}, {}
            for count in SIZES:
                scene, pages[count] = of_size(gaussians, count, degree), Path(folder) / f"{count}.html"
                pictures[count] = np.clip(sx.render(scene, camera).rgb, 0, 1)
                began = time.process_time()
                web.save(pages[count], scene, title=str(count), cameras={"start": camera})
                size, took = pages[count].stat().st_size / 1e6, time.process_time() - began
                print(f"degree {degree}, {count:,} Gaussians: {size:.1f} MB, written in {took:.0f} s of CPU")
            measure(playwright, pages, pictures, rounds)


def measure(
    playwright: Playwright, pages: dict[int, Path], pictures: dict[int, np.ndarray], rounds: int
) -> None:
    """Opens pages in turns, once until they are complete, and prints a line for each."""
    found: dict[int, list] = {count: [] for count in pages}
    for last in [*["opened"] * (rounds - 1), "complete"]:
        for count, page in pages.items():
            found[count].append(opened(playwright, page, last))
    for count, runs in found.items():
        error = np.mean((runs[-1][1] - pictures[count]) ** 2)
        print(f"  {count:,}: {runs[-1][2]:,} splats, {-10 * np.log10(error):.2f} dB")
        for kind in ("", "CPU "):
            marks = {mark: [run[0][kind + mark] for run in runs if mark in run[0]] for mark in MARKS}
            line = ", ".join(f"{mark} {np.median(times):.2f} s" for mark, times in marks.items())
            print(f"    {kind or 'wall '}", line)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:3]))
