"""Trains drawn captures through a rolling shutter and through panoramas: the figures of lenses.md.

python docs/lens_trials.py FOLDER        writes pictures to FOLDER and prints the scores
"""

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import splatax as sx
from splatax.cameras import Camera, RollingShutter, panorama
from splatax.dataset import Dataset, View
from splatax.demo.dataset import demo_dataset
from splatax.demo.raycast import photograph
from splatax.demo.scenes import scene_named
from splatax.io import images
from splatax.training.camera_refinement import Poses, Shutter, Together
from splatax.training.recipes import default

STEPS, GAUSSIANS = 800, 6000


def drawn(view: View, camera: Camera, scene: str) -> View:
    """Returns the view of another camera of a scene, with its photo."""
    return View(view.name, camera, cache(partial(_photo, camera, scene)))


def _photo(camera: Camera, scene: str) -> np.ndarray:
    return np.asarray(photograph(camera, scene_named(scene)))[..., :3]


def trained(dataset: Dataset, **parts) -> sx.Gaussians:
    """Returns the scene of a run of `default` with other parts."""
    return sx.fit(dataset, replace(default(STEPS, GAUSSIANS), **parts))


def side_by_side(path: Path, *pictures: np.ndarray) -> None:
    """Writes pictures of values in [0, 1] or of 8 bits beside each other."""
    levels = [
        p if p.dtype == np.uint8 else np.round(255 * np.clip(p, 0, 1)).astype(np.uint8) for p in pictures
    ]
    images.write(path, np.concatenate(levels, axis=1))


def shutter(out: Path) -> None:
    """Photos by cameras that turn by two degrees and move while their rows are exposed; still test views."""
    still = demo_dataset(width=192, height=144)
    rng = np.random.default_rng(0)
    train = []
    for view in still.train:
        twist = jnp.asarray(rng.normal(size=6) * np.repeat([0.025, 0.04], 3), jnp.float32)
        train.append(drawn(view, replace(view.camera, motion=RollingShutter(twist)), "still-life"))
    true = replace(still, train=tuple(train))
    ignored = replace(true, train=tuple(replace(v, camera=replace(v.camera, motion=None)) for v in train))
    runs = {
        "motion ignored": (ignored, {}),
        "motion learned": (ignored, {"camera_refinement": Shutter(reach=0.1)}),
        "motion and poses learned": (
            ignored,
            {"camera_refinement": Together((Shutter(reach=0.1), Poses()))},
        ),
        "motion given": (true, {}),
        "no motion in the photos": (still, {}),
    }
    view = still.test[1]
    shown = [view.pixels()]
    for name, (dataset, parts) in runs.items():
        scene = trained(dataset, **parts)
        score = sx.evaluate(scene, still.test)
        print(f"{name:26} {score.psnr:6.2f} dB {score.ssim:.3f}", flush=True)
        if name in ("motion ignored", "motion learned", "motion given"):
            shown.append(np.asarray(sx.render(scene, view.camera).rgb))
    side_by_side(out / "shutter.png", *shown)


def around(out: Path) -> None:
    """Panoramas from inside the drawn room, trained as they are, scored on panoramas and on pinholes."""
    room = demo_dataset(scene="room", width=128, height=96)

    def turned(view: View) -> View:
        return drawn(view, panorama(view.camera.cam_from_world, 256, 128), "room")

    whole = replace(room, train=tuple(map(turned, room.train)), test=tuple(map(turned, room.test)))
    scene = trained(whole)
    for name, views in (("panoramas", whole.test), ("pinholes", room.test)):
        score = sx.evaluate(scene, views)
        print(
            f"room, trained on panoramas, scored on {name:10} {score.psnr:6.2f} dB {score.ssim:.3f}",
            flush=True,
        )
    view = whole.test[0]
    side_by_side(out / "panorama.png", view.pixels(), np.asarray(sx.render(scene, view.camera).rgb))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    shutter(folder)
    around(folder)
