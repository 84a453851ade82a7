"""Makes the toy car of scenes.md and configurator.md, and draws the pictures of these pages.

    python docs/make_scenes.py FOLDER             # the splat files of the car, and car.toml
    python docs/make_scenes.py FOLDER pictures    # also docs/images/{scenes,configurator}.jpg

The second picture is a screenshot, which needs playwright with Chromium (SPLATAX_CHROMIUM names another one).
"""

import os
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatax as sx
from splatax import web
from splatax.math import harmonics
from splatax.metrics import to_8bit
from splatax.scene import chosen

IMAGES = Path(__file__).parent / "images"
SIZE = (480, 300)
QUALITY = 88
LIGHT = np.array([-0.4, -0.8, -0.5]) / np.linalg.norm([0.4, 0.8, 0.5])  # towards the light; y points down
SOFTWARE = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
CAR = """title = "Toy car"
background = "white"
[parts.body]
file = "body.ply"
[parts.windows]
file = "windows.ply"
[parts.front]
file = "wheel.ply"
move = [-0.95, 0.42, 0]
[parts.rear]
file = "wheel.ply"
move = [0.95, 0.42, 0]
[parts.wing]
file = "wing.ply"
[variants.paint.silver]
[variants.paint.red]
dye.body = [1.3, 0.2, 0.15]
[variants.paint.blue]
dye.body = [0.2, 0.45, 1.3]
[variants.rims.grey]
[variants.rims.gold]
dye.front = [1.6, 1.2, 0.5]
dye.rear = [1.6, 1.2, 0.5]
[variants.rear.plain]
show = []
[variants.rear.wing]
show = ["wing"]
[[hotspots]]
at = [-1.5, -0.05, -0.5]
text = "Lamps of moulded glass"
[[hotspots]]
at = [1.35, -0.75, 0]
text = "A wing of carbon"
part = "wing"
[start]
position = [-3.2, -1.6, -4.2]
target = [0, -0.1, 0]
fov = 34
"""


def write_car(folder: Path) -> None:
    """Writes the files of the car."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, gaussians in parts().items():
        sx.save(folder / f"{name}.ply", gaussians)
    (folder / "car.toml").write_text(CAR)


def draw(folder: Path) -> None:
    """Draws the pictures of the car in a folder."""
    found = web.compose(folder / "car.toml")
    start = found.presentation.start
    assert start is not None
    camera = start.resized(*SIZE)
    choices = ({}, {"paint": "red", "rims": "gold"}, {"paint": "blue", "rear": "wing"})
    shown = [chosen(found.scene, found.presentation.variants, choice) for choice in choices]
    row = [to_8bit(np.asarray(sx.render(scene, camera, background=sx.WHITE).rgb)) for scene in shown]
    IMAGES.mkdir(exist_ok=True)
    Image.fromarray(np.concatenate(row, axis=1)).save(IMAGES / "scenes.jpg", quality=QUALITY)
    offered = {"background": (1.0, 1.0, 1.0), "presentation": found.presentation}
    web.save(folder / "car.html", found.scene, title=found.title, **offered)
    screenshot(folder / "car.html")


def parts() -> dict[str, sx.Gaussians]:
    """Returns the Gaussians of the car's parts, in the car's coordinates except for the wheel."""
    rng = np.random.default_rng(0)
    body = [
        box(rng, 6000, (0, 0.1, 0), (1.7, 0.32, 0.75)),
        box(rng, 2500, (0.15, -0.32, 0), (0.95, 0.3, 0.62)),
    ]
    glass = box(rng, 2500, (0.15, -0.34, 0), (0.98, 0.2, 0.64))
    sides = [torus(rng, 1500, (0, 0, z), 0.27, 0.12) for z in (-0.72, 0.72)]
    rims = [disc(rng, 500, (0, 0, z), 0.2) for z in (-0.8, 0.8)]
    wing = [
        box(rng, 1200, (1.45, -0.75, 0), (0.22, 0.03, 0.75)),
        box(rng, 300, (1.45, -0.5, 0), (0.05, 0.25, 0.5)),
    ]
    return {
        "body": cloud(body, 0.62, 0.035),
        "windows": cloud([glass], 0.12, 0.035),
        "wheel": sx.editing.merge([cloud(sides, 0.1, 0.03), cloud(rims, 0.6, 0.025)]),
        "wing": cloud(wing, 0.15, 0.025),
    }


def box(rng, n, middle, half):
    """Returns points and normals of a box with round edges."""
    half = np.array(half)
    areas = np.prod(half) / half
    axis = rng.choice(3, n, p=areas / areas.sum())
    cube = rng.uniform(-1, 1, (n, 3))
    cube[np.arange(n), axis] = rng.choice([-1.0, 1.0], n)
    normals = cube**9 / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    round_ = np.sum(np.abs(cube) ** 9, axis=1, keepdims=True) ** (1 / 9)
    return middle + cube / round_ * half, normals


def torus(rng, n, middle, radius, thickness):
    """Returns points and normals of a tyre about the z axis."""
    u, v = rng.uniform(0, 2 * np.pi, (2, n))
    normals = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=1)
    ring = np.stack([np.cos(u), np.sin(u), np.zeros(n)], axis=1)
    return middle + radius * ring + thickness * normals, normals


def disc(rng, n, middle, radius):
    """Returns points and normals of a rim about the z axis."""
    angle, far = rng.uniform(0, 2 * np.pi, n), radius * np.sqrt(rng.uniform(size=n))
    points = np.stack([far * np.cos(angle), far * np.sin(angle), np.zeros(n)], axis=1)
    return middle + points, np.tile([0, 0, np.sign(middle[2])], (n, 1))


def cloud(surfaces, gray, sigma):
    """Returns Gaussians on surfaces, shaded by one light."""
    points, normals = (np.concatenate(arrays) for arrays in zip(*surfaces, strict=True))
    shade = gray * (0.45 + 0.75 * np.maximum(normals @ LIGHT, 0))
    n = len(points)
    arrays = (
        points,
        np.tile([1, 0, 0, 0], (n, 1)),
        np.full((n, 3), np.log(sigma)),
        np.full(n, 2.5),
        harmonics.from_rgb(np.repeat(shade[:, None, None], 3, axis=2)),
    )
    return sx.Gaussians(*(jnp.asarray(array, jnp.float32) for array in arrays))


def screenshot(path: Path) -> None:
    """Writes docs/images/configurator.jpg, the page with another choice than its first."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        named = os.environ.get("SPLATAX_CHROMIUM")
        browser = started.chromium.launch(executable_path=named, args=[*SOFTWARE, "--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1000, "height": 560})
        tab.goto(path.resolve().as_uri())
        for _ in range(400):
            tab.wait_for_timeout(100)
            if tab.evaluate("Boolean(window.viewer) && viewer.settled"):
                break
        tab.get_by_role("button", name="red").click()
        tab.get_by_role("button", name="wing", exact=True).click()
        tab.wait_for_timeout(8000)  # until the hint is gone
        for _ in range(400):
            tab.wait_for_timeout(100)
            if tab.evaluate("viewer.settled"):
                break
        tab.screenshot(path=IMAGES / "configurator.jpg", quality=QUALITY)
        browser.close()


if __name__ == "__main__":
    write_car(Path(sys.argv[1]))
    if "pictures" in sys.argv[2:]:
        draw(Path(sys.argv[1]))
