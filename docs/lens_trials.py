"""Trains captures through their lenses: the figures and pictures of lenses.md.

    python docs/lens_trials.py FOLDER [TRIAL ...]        prints the scores and writes pictures to FOLDER

The trials are shutter, panorama and distortion, on synthetic captures that the script renders, and fern,
which needs the capture fern_radial in the folder that the variable SPLATAX_DATA names. Without a name, the
trials on synthetic captures run.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatax as sx
from splatax.cameras import Camera, RollingShutter, panorama
from splatax.cameras.lenses import opencv
from splatax.dataset import Dataset, View
from splatax.demo.dataset import demo_dataset
from splatax.demo.raycast import photograph
from splatax.demo.scenes import scene_named
from splatax.training.camera_refinement import CAMERA_REFINEMENTS, Poses, Shutter, Together, refined
from splatax.training.loop import optimize
from splatax.training.recipes import default

STEPS, GAUSSIANS = 400, 4000
K1, K2 = -0.2, 0.05
SIDES = 60.0  # degrees from a camera's axis


def drawn(view: View, camera: Camera, scene: str) -> View:
    """Returns the view of another camera of a scene, with its photo."""
    return View(view.name, camera, cache(partial(_photo, camera, scene)))


def _photo(camera: Camera, scene: str) -> np.ndarray:
    return np.asarray(photograph(camera, scene_named(scene)))[..., :3]


def trained(dataset: Dataset, **parts) -> sx.Gaussians:
    """Returns the scene of a run of `default` with other parts."""
    return sx.fit(dataset, replace(default(STEPS, GAUSSIANS), **parts))


def write(path: Path, *rows: tuple[np.ndarray, ...]) -> None:
    """Writes rows of pictures of values in [0, 1] or of 8 bits."""

    def levels(picture: np.ndarray) -> np.ndarray:
        if picture.dtype == np.uint8:
            return picture
        return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)

    picture = np.concatenate([np.concatenate([levels(p) for p in row], axis=1) for row in rows])
    Image.fromarray(picture).save(path, quality=90)


def shutter(out: Path) -> None:
    """Photos by cameras that turn by two degrees and move while their rows are exposed; still test views."""
    still = demo_dataset(width=160, height=120)
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
        "motion given": (true, {}),
        "no motion in the photos": (still, {}),
        "motion and poses learned": (
            ignored,
            {"camera_refinement": Together((Shutter(reach=0.1), Poses()))},
        ),
    }
    view = still.test[1]
    shown = [train[1].pixels(), view.pixels()]
    for name, (dataset, parts) in runs.items():
        scene = trained(dataset, **parts)
        score = sx.evaluate(scene, still.test)
        print(f"{name:26} {score.psnr:6.2f} dB {score.ssim:.3f}", flush=True)
        if len(shown) < 4:
            shown.append(np.asarray(sx.render(scene, view.camera).rgb))
            write(out / "rolling-shutter.jpg", tuple(shown))


def around(out: Path) -> None:
    """Panoramas from inside the synthetic room, trained as they are, scored on panoramas and on pinholes."""
    room = demo_dataset(scene="room", width=96, height=72)

    def turned(view: View) -> View:
        return drawn(view, panorama(view.camera.cam_from_world, 192, 96), "room")

    whole = replace(room, train=tuple(map(turned, room.train)), test=tuple(map(turned, room.test)))
    scene = trained(whole)
    for name, views in (("panoramas", whole.test), ("pinholes", room.test)):
        score = sx.evaluate(scene, views)
        print(
            f"room, trained on panoramas, scored on {name:10} {score.psnr:6.2f} dB {score.ssim:.3f}",
            flush=True,
        )
    near = [sx.evaluate(without_sides(scene, view.camera), [view]).psnr for view in room.test]
    print(
        f"the same, without Gaussians more than {SIDES:.0f} degrees off the axis {np.mean(near):6.2f} dB",
        flush=True,
    )
    view = whole.test[0]
    write(out / "panorama.jpg", (view.pixels(),), (np.asarray(sx.render(scene, view.camera).rgb),))


def without_sides(scene: sx.Gaussians, camera: Camera) -> sx.Gaussians:
    """Returns a scene whose Gaussians are transparent where they are far from the axis of a camera."""
    points = scene.means @ camera.rotation.T + camera.translation
    angles = jnp.degrees(jnp.arccos(points[:, 2] / jnp.linalg.norm(points, axis=1)))
    return replace(scene, opacity_logits=jnp.where(angles > SIDES, -20.0, scene.opacity_logits))


def distortion(out: Path) -> None:
    """Photos of a lens whose k1 and k2 are set to zero in the capture, and learned."""
    still = demo_dataset(width=192, height=144)
    lens = opencv(K1, K2)

    def bent(view: View) -> View:
        camera = replace(view.camera, lens=lens, fx=0.7 * view.camera.fx, fy=0.7 * view.camera.fy)
        return drawn(view, camera, "still-life")

    true = replace(still, train=tuple(map(bent, still.train)), test=tuple(map(bent, still.test)))
    zeroed = tuple(replace(v, camera=replace(v.camera, lens=opencv())) for v in true.train)
    recipe = replace(default(STEPS, GAUSSIANS), camera_refinement=CAMERA_REFINEMENTS["lens"])
    for progress in optimize(replace(true, train=zeroed), recipe):
        pass
    state = progress.state.train
    first, *_ = refined(recipe.camera_refinement, state.cameras, zeroed[:1], state.extent)
    k1, k2 = map(float, first.camera.lens.radials[:2])
    ratio = float(first.camera.fx / true.train[0].camera.fx)
    print(f"distortion: k1 {k1:.4f} of {K1}, k2 {k2:.4f} of {K2}, focal length {ratio:.4f}", flush=True)


def fern(out: Path) -> None:
    """Fern through its lens, and undistorted; both scored on the same held-out photos as they are."""
    folder = Path(os.environ["SPLATAX_DATA"]) / "fern_radial"
    through, straight = (sx.load_dataset(folder, downscale=2, undistort=u) for u in (False, True))
    shown = [through.test[0].pixels()]
    for name, dataset in (("through the lens", through), ("undistorted", straight)):
        scene = sx.fit(dataset, default(400, 10_000))
        score = sx.evaluate(scene, through.test)
        print(f"fern_radial, {name:17} {score.psnr:6.2f} dB {score.ssim:.3f}", flush=True)
        shown.append(np.asarray(sx.render(scene, through.test[0].camera).rgb))
    write(out / "fern_radial.jpg", tuple(shown))


TRIALS: dict[str, Callable[[Path], None]] = {
    "shutter": shutter,
    "panorama": around,
    "distortion": distortion,
    "fern": fern,
}

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or ("shutter", "panorama", "distortion"):
        TRIALS[name](folder)
