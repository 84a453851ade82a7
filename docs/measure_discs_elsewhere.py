"""Measures how discs look where they are drawn as ellipses: on a page, and in a file for other viewers.

    splatax demo --out RUN                             and
    splatax train RUN/capture --recipe 2dgs --steps 2000 --out RUN2
    python docs/measure_discs_elsewhere.py RUN/capture RUN2

For each held-out photo, the page is opened in headless Chromium (SPLATAX_CHROMIUM, or that on the path) in a
window of the photo's size. The script prints PSNR against `render`, and PSNR against the photos: of `render`,
of the page, of an .spz file, which does not store how its scene is drawn, and of the scene as thin ellipses
with several dilations. The values are means over the photos.
"""

import io
import os
import shutil
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

import splatax as sx
from splatax import web
from splatax.evaluation import photo_of, picture
from splatax.low_pass import LowPass
from splatax.metrics import psnr

FLAGS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
READY = "Boolean(window.viewer) && !viewer.motion && viewer.settled"
PATIENCE = 120  # seconds
VARIANCES = (0.0, 0.03, 0.06, 0.1, 0.2, 0.3)  # of dilations, pixels^2


def main(capture: Path, run: Path) -> None:
    scene, views = sx.load(run / "scene.ply"), sx.load_dataset(capture).test
    photos = [photo_of(view, (0, 0, 0)) for view in views]
    exact = drawn(scene, views)
    told("render", exact, exact, photos)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "scene.html"
        web.save(page, scene, title="discs", cameras={view.name: view.camera for view in views})
        told("page", pictures_of(page, views), exact, photos)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the format does not store the filter
            sx.save(Path(folder) / "scene.spz", scene)
        told(".spz file", drawn(sx.load(Path(folder) / "scene.spz"), views), exact, photos)
    for variance in VARIANCES:
        told(f"dilation {variance}", drawn(scene, views, sx.Dilation(variance)), exact, photos)


def drawn(
    scene: sx.Gaussians, views: tuple[sx.View, ...], low_pass: LowPass | None = None
) -> list[np.ndarray]:
    """Returns pictures of a scene, with its own filter or another one."""
    shown = scene if low_pass is None else replace(scene, low_pass=low_pass)
    return [picture(shown, view.camera) for view in views]


def told(name: str, found: list[np.ndarray], exact: list[np.ndarray], photos: list[np.ndarray]) -> None:
    """Prints the mean PSNR of pictures against `render` and against the photos."""
    line = f"{name}: {mean_psnr(found, photos):.2f} dB against the photos"
    if found is not exact:
        line += f", {mean_psnr(found, exact):.2f} dB against render"
    print(line, flush=True)


def mean_psnr(found: list[np.ndarray], expected: list[np.ndarray]) -> float:
    """Returns the mean PSNR of 8-bit pictures, dB."""
    return float(np.mean([psnr(a, b) for a, b in zip(found, expected, strict=True)]))


def pictures_of(page: Path, views: tuple[sx.View, ...]) -> list[np.ndarray]:
    """Returns what a page shows at the cameras of views."""
    found = []
    with sync_playwright() as playwright:
        path = os.environ.get("SPLATAX_CHROMIUM") or shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=path, args=[*FLAGS])
        for index, view in enumerate(views):
            size = {"width": view.camera.width, "height": view.camera.height}
            tab = browser.new_page(viewport=size, reduced_motion="reduce")
            tab.goto(page.as_uri())
            settled(tab)
            tab.evaluate(f"viewer.show({index})")
            settled(tab)
            tab.evaluate("document.body.classList.add('bare')")
            with Image.open(io.BytesIO(tab.screenshot())) as image:
                found.append(np.asarray(image.convert("RGB")))
            tab.close()
        browser.close()
    return found


def settled(tab) -> None:
    """Waits until a page is open and its picture final."""
    end = time.monotonic() + PATIENCE
    while not tab.evaluate(READY):
        assert time.monotonic() < end, "the page did not open"
        time.sleep(0.05)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
