"""Scores scenes of drawn captures between their photos.

python docs/measure_novel.py SCENE STEPS SEEDS TRIALS
    SCENE    name of a drawn scene, such as room
    STEPS    of each run
    SEEDS    whole numbers with commas
    TRIALS   names with commas, as `measure_trials.py` takes them

Each camera of the scores is that of a training photo, moved by 15 % of the scene's extent and turned by 0.2
radians (standard deviations along each axis). Few views of a scene are bad, so the worst of them tell more
than the mean.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from measure_trials import trial_named
from scipy.spatial.transform import Rotation

import splatax as sx
from splatax.demo.raycast import photograph
from splatax.demo.scene import SIZE
from splatax.demo.scenes import SCENES
from splatax.evaluation import picture
from splatax.training.recipes import default, room_for

MOVED, TURNED = 0.15, 0.2  # extents of the scene, radians


def moved(camera: sx.Camera, extent: float, rng: np.random.Generator) -> sx.Camera:
    """Returns a camera near another."""
    pose = np.eye(4)
    turn = Rotation.from_rotvec(rng.normal(0, TURNED, 3)).as_matrix()
    pose[:3, :3] = turn @ np.asarray(camera.rotation, np.float64)
    place = np.asarray(camera.position, np.float64) + rng.normal(0, MOVED * extent, 3)
    pose[:3, 3] = -pose[:3, :3] @ place
    return replace(camera, cam_from_world=jnp.asarray(pose, jnp.float32))


def psnr_of(drawn: np.ndarray, truth: np.ndarray) -> float:
    """Returns the PSNR of two 8-bit pictures, dB."""
    return float(10 * np.log10(255**2 / np.mean((drawn.astype(np.float64) - truth) ** 2)))


def main(name: str, steps: int, seeds: Sequence[int], trials: Sequence[str]) -> None:
    """Prints a line for each run."""
    dataset, rng = sx.demo_dataset(scene=name, width=SIZE[0], height=SIZE[1]), np.random.default_rng(5)
    cameras = [moved(view.camera, dataset.extent, rng) for view in dataset.train]
    truths = [np.asarray(photograph(camera, SCENES[name]))[..., :3] for camera in cameras]
    for seed in seeds:
        for trial in trials:
            trained = trial_named(trial)(dataset, replace(default(steps, room_for(dataset)), seed=seed))
            scene = trained.scene
            drawn = (picture(scene, camera) for camera in cameras)
            found = np.sort([psnr_of(*pair) for pair in zip(drawn, truths, strict=True)])
            print(
                f"{name} seed {seed} {trial:20}: mean {found.mean():.2f} dB, tenth "
                f"{found[len(found) // 10]:.2f}, worst {found[0]:.2f}; largest scale "
                f"{float(np.exp(np.asarray(scene.log_scales)).max()):.1f}, {trained.seconds:.1f} s of CPU",
                flush=True,
            )


if __name__ == "__main__":
    chosen, count, numbers, names = sys.argv[1:]
    main(chosen, int(count), [int(n) for n in numbers.split(",")], names.split(","))
