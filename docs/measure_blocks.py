"""Measures blocks against one run: `python docs/measure_blocks.py draw|train|compare|memory ...`.

draw FOLDER                        a synthetic city as a capture: 98 photos, each of which shows a part of it
train CAPTURE FOLDER N [OPTIONS]   one run and N blocks by the command line, with options of both such as
                                   `--steps 1500 --max-gaussians 24000`; allow at least as many Gaussians as
                                   the capture has points, because one run starts from all of them
compare CAPTURE FOLDER [DOWNSCALE] scores and memory of both, near the borders of boxes and elsewhere, and a
                                   picture of the seams (docs/images/blocks.jpg)
"""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from scipy.ndimage import maximum_filter, minimum_filter

import splatax as sx
from splatax.blocks.boxes import block_of, places_of
from splatax.blocks.plan import folder_of, read_context, read_plan
from splatax.cameras.geometry import points_at
from splatax.evaluation import picture
from splatax.io.datasets import colmap_writing
from splatax.math import harmonics
from splatax.training.feed import Batch
from splatax.training.loop import first_state
from splatax.training.step import _train_step

SIZE, FOCAL = (160, 120), 110.0
WIDE, HIGH = 12.0, 1.5  # world units: side of the city, and the highest house
NEAR_BORDER = 32  # pixels
PICTURE = Path(__file__).parent / "images" / "blocks.jpg"


def city(seed: int = 0) -> sx.Gaussians:
    """Returns a ground with streets and houses, painted with noise on several scales."""
    rng = np.random.default_rng(seed)
    parts = [rng.uniform((-WIDE / 2, -WIDE / 2, 0), (WIDE / 2, WIDE / 2, 0), (40_000, 3))]
    flat = [np.tile((0.0, 0.0, 1.0), (40_000, 1))]
    for x, y in np.stack(np.meshgrid(*2 * (np.arange(-5, 5, 1.5),)), axis=-1).reshape(-1, 2):
        half = rng.uniform(0.3, 0.55, 2)
        height = rng.uniform(0.3, HIGH)
        sides = rng.integers(0, 5, 900)
        spots = rng.uniform(-1, 1, (900, 3)) * (*half, height / 2) + (x, y, height / 2)
        normals = np.zeros((900, 3))
        for side, (axis, sign) in enumerate([(0, -1), (0, 1), (1, -1), (1, 1), (2, 1)]):
            here = sides == side
            spots[here, axis] = (x, y, height / 2)[axis] + sign * (*half, height / 2)[axis]
            normals[here, axis] = sign
        parts.append(spots)
        flat.append(normals)
    means, normals = np.concatenate(parts), np.concatenate(flat)
    waves = rng.normal(size=(3, 12, 3)) * np.geomspace(0.5, 12, 12)[:, None]
    phases = means @ waves.transpose(0, 2, 1).reshape(3, 3, 12) + rng.uniform(0, 6, (3, 1, 12))
    colors = np.clip(0.5 + 0.07 * np.sin(phases).sum(axis=-1).T + 0.1 * normals, 0.02, 0.98)
    thin = np.log(np.where(np.abs(normals) > 0.5, 0.004, 0.05))
    return sx.Gaussians(
        jnp.asarray(means, jnp.float32),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(means), 1)),
        jnp.asarray(thin, jnp.float32),
        jnp.full(len(means), 3.0),
        jnp.asarray(harmonics.from_rgb(colors)[:, None], jnp.float32),
    )


def draw(folder: Path) -> None:
    """Writes a capture of the city, photographed from a grid of places, in four directions."""
    scene, rng, views = city(), np.random.default_rng(1), []
    (folder / "images").mkdir(parents=True)
    places = np.stack(np.meshgrid(*2 * (np.linspace(-4.5, 4.5, 7),)), axis=-1).reshape(-1, 2)
    for index, (x, y) in enumerate(places):
        for turn in (0, 1):
            angle = np.arctan2(-y, -x) + rng.uniform(-1.3, 1.3)  # not out of the city
            eye = np.array([x, y, rng.uniform(2.2, 2.8)])
            target = eye + (2 * np.cos(angle), 2 * np.sin(angle), -2.2)
            pose = sx.look_at(*(jnp.asarray(v, jnp.float32) for v in (eye, target, (0.0, 0, 1))))
            camera = sx.Camera.simple_pinhole(FOCAL, pose, *SIZE)
            name = f"{index:03}-{turn}.png"
            Image.fromarray(picture(scene, camera)).save(folder / "images" / name)
            views.append(sx.View(name, camera, lambda: np.zeros((1, 1, 3), np.uint8)))
    rows = np.sort(rng.choice(len(scene), 3_000, replace=False))
    colors = np.clip(harmonics.to_rgb(np.asarray(scene.sh)[rows, 0]), 0, 1)
    colmap_writing.save(folder, views, sx.PointCloud(np.asarray(scene.means)[rows], colors))


def train(capture: Path, folder: Path, blocks: int, options: list[str]) -> None:
    """Trains one run of the whole, and the blocks, and merges them."""
    command = [sys.executable, "-m", "splatax"]
    commands = [
        ["train", capture, "--out", folder / "whole", *options],
        ["blocks", "plan", capture, "--out", folder / "city", "--blocks", blocks, *options],
        *(["blocks", "train", folder / "city", block] for block in range(blocks)),
        ["blocks", "merge", folder / "city", folder / "city" / "scene.ply"],
    ]
    for words in commands:
        subprocess.run([*command, *map(str, words)], check=True)


def compare(capture: Path, folder: Path, downscale: int | None) -> None:
    """Prints the scores and the memory of both, and saves a picture of the seams."""
    dataset = sx.load_dataset(capture, downscale=downscale)
    plan = read_plan(folder / "city")
    scenes = {"whole": sx.load(folder / "whole" / "scene.ply"), "merged": sx.load(folder / "city/scene.ply")}
    runs = {"whole": folder / "whole", "coarse": folder / "city" / "coarse"}
    runs |= {f"block {i}": folder_of(folder / "city", i) for i in range(len(plan.blocks))}
    for name, run in runs.items():
        found = json.loads((run / "metrics.json").read_text())
        memory, count, steps = found["peak_rss_bytes"] / 1e9, found["gaussians"], found["steps"]
        print(f"{name}: {count:,} Gaussians, {steps:,} steps, peak of the process {memory:.2f} GB")
    errors: dict[str, list[list[float]]] = {name: [] for name in scenes}
    seams = []
    for view in dataset.test:
        photo = view.pixels()[..., :3] / 255
        near, border = near_borders(scenes["merged"], view.camera, plan)
        images = {name: picture(scene, view.camera) / 255 for name, scene in scenes.items()}
        for name, image in images.items():
            squared = np.mean((image - photo) ** 2, axis=-1)
            parts = (squared, squared[near], squared[~near])
            errors[name].append([part.mean() if part.size > 200 else np.nan for part in parts])
        seams.append((border.sum(), photo, images["merged"], border, images["whole"]))
    psnrs = {name: np.nanmean(-10 * np.log10(np.array(rows)), axis=0) for name, rows in errors.items()}
    for name, (everywhere, close, far) in psnrs.items():
        print(
            f"{name}: {len(scenes[name]):,} Gaussians, PSNR {everywhere:.2f} dB; within {NEAR_BORDER} px of "
            f"a border {close:.2f} dB, elsewhere {far:.2f} dB"
        )
    lost = psnrs["merged"] - psnrs["whole"]
    print(f"merged - whole: {lost[0]:+.2f} dB; near borders {lost[1]:+.2f} dB, elsewhere {lost[2]:+.2f} dB")
    seams.sort(key=lambda seam: -seam[0])
    save_picture([seam[1:] for seam in seams[:3]])


def memory(folder: Path, gaussians: int) -> None:
    """Prints the bytes that a compiled step needs, which the compiler counts: nothing is run."""
    plan = read_plan(folder)
    total = json.loads((folder / "blocks.json").read_text())["options"]["max_gaussians"]
    coarse = len(sx.load(plan.coarse))
    whole = step_bytes(gaussians, 0)
    print(f"whole: {gaussians:,} Gaussians, {whole / 1e9:.2f} GB")
    for number, block in enumerate(plan.blocks):
        own = round(gaussians * block.gaussians / total)
        around = round(gaussians / total * int(read_context(folder, number, coarse).sum()))
        needed = step_bytes(own, around)
        print(
            f"block {number}: {own:,} Gaussians, {around:,} around them, {needed / 1e9:.2f} GB, "
            f"{needed / whole:.0%} of the whole"
        )


def step_bytes(gaussians: int, around: int) -> int:
    """Returns the bytes of the state, of the context and of all intermediate arrays of a step."""
    recipe = sx.recipes.default(steps=1_000, max_gaussians=gaussians).on(sx.backends.resolve("cpu"))

    def scene(rows: int) -> sx.Gaussians:
        zeros = (jnp.zeros((rows, *shape)) for shape in ((3,), (4,), (3,), (), (16, 3)))
        return sx.Gaussians(*zeros)

    camera = sx.Camera.simple_pinhole(500.0, jnp.eye(4), 504, 378)
    photo = jax.ShapeDtypeStruct((378, 504, 3), jnp.uint8)
    fraction = jnp.float32(0.25) if around else None
    context = jax.eval_shape(lambda: scene(around)) if around else None
    state = jax.eval_shape(lambda: first_state(scene(gaussians), recipe, 1.0, 10))
    rates, openings = recipe.optimizer.rates, jnp.asarray(recipe.sh.openings(recipe.steps))
    batch = Batch(camera, photo, context=context, fraction=fraction)
    compiled = _train_step.lower(state, batch, rates, openings, recipe).compile()
    found = compiled.memory_analysis()
    return found.argument_size_in_bytes + found.temp_size_in_bytes  # the state is donated: no output is added


def near_borders(scene: sx.Gaussians, camera: sx.Camera, plan) -> tuple[np.ndarray, np.ndarray]:
    """Returns masks of the pixels near a border of boxes, and on it, by the depth of a scene."""
    depth = np.asarray(sx.render(scene, camera, outputs=("median_depth",)).images["median_depth"])
    height, width = depth.shape
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    points = points_at(camera, pixels, np.maximum(depth.ravel(), 1e-3))
    numbers = block_of(places_of(points, plan.axes), plan.boxes).reshape(height, width)
    border = maximum_filter(numbers, 2) != minimum_filter(numbers, 2)
    return maximum_filter(border, 2 * NEAR_BORDER + 1), border


def save_picture(rows: list) -> None:
    """Saves photos, the merged scene, the same with the borders of boxes in red, and the scene of one run."""
    lines = []
    for photo, image, border, whole in rows:
        marked = np.where(border[..., None], (1.0, 0.1, 0.1), image)
        lines.append(np.concatenate([photo, image, marked, whole], axis=1))
    pixels = np.clip(np.concatenate(lines) * 255, 0, 255).astype(np.uint8)
    big = Image.fromarray(pixels).resize((pixels.shape[1] * 2, pixels.shape[0] * 2), Image.Resampling.LANCZOS)
    big.save(PICTURE, quality=80)


if __name__ == "__main__":
    what, *words = sys.argv[1:]
    if what == "draw":
        draw(Path(words[0]))
    elif what == "train":
        train(Path(words[0]), Path(words[1]), int(words[2]), words[3:])
    elif what == "memory":
        memory(Path(words[0]), int(words[1]))
    else:
        jax.config.update("jax_platforms", "cpu")
        compare(Path(words[0]), Path(words[1]), int(words[2]) if words[2:] else None)
