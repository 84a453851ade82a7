"""Compares training with and without refined cameras, scored on training photos that no run has seen.

python docs/measure_poses.py CAPTURES SEEDS REFINEMENTS [STEPS [DOWNSCALE [TURNED]]]
    REFINEMENTS     names of `CAMERA_REFINEMENTS` with commas: none, poses, ...
    TURNED          pixels by which the training cameras are turned at random before training, 0 by default
    (the other arguments are those of `measure_long.py`, with 1,500 steps and a downscale of 2 by default)

Photos are scored from their given poses, and again with poses adjusted to them. The distance is that of
pixels in which a training camera sees the points of the capture, before and after training, as a root mean
square over all cameras: of cameras that were not turned, it is the error that refinement adds.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from measure_long import loaded

import splatax as sx
from splatax.adjustment import evaluate_adjusted
from splatax.cameras import Camera
from splatax.dataset import Dataset, View
from splatax.math import rigid
from splatax.training.camera_refinement import CAMERA_REFINEMENTS, refined
from splatax.training.recipes import default, room_for

DEFAULTS = 1_500, 2, 0  # steps, downscale, and pixels
POINTS = 500  # by which cameras are compared


def turned(views: Sequence[View], pixels: float, seed: int) -> tuple[View, ...]:
    """Returns views whose cameras are turned about their centres, by so many pixels on average."""
    rng = np.random.default_rng(seed)

    def turn(camera: Camera) -> Camera:
        axis = rng.normal(size=3)
        twist = np.concatenate([axis / np.linalg.norm(axis) * pixels / float(camera.fx), np.zeros(3)])
        delta = rigid.exponential(jnp.asarray(twist, jnp.float32))
        return replace(camera, cam_from_world=delta @ camera.cam_from_world)

    return tuple(replace(view, camera=turn(view.camera)) for view in views)


def apart(views: Sequence[View], others: Sequence[View], positions: np.ndarray) -> float:
    """Returns how far apart two sets of cameras see points, pixels."""
    points = jnp.asarray(positions[:: max(len(positions) // POINTS, 1)], jnp.float32)
    errors = []
    for view, other in zip(views, others, strict=True):
        local = [jax.vmap(each.camera.to_camera)(points) for each in (view, other)]
        first, second = (
            np.asarray(jax.vmap(each.camera.to_pixel)(there))
            for each, there in zip((view, other), local, strict=True)
        )
        size = np.array([view.camera.width, view.camera.height])
        inside = (np.asarray(local[0])[:, 2] > 0) & np.all((first > 0) & (first < size), axis=1)
        errors.append(np.sum((first - second)[inside] ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(errors))))


def run(capture: Dataset, dataset: Dataset, seed: int, name: str, steps: int) -> str:
    """Trains once and returns the scores in words.

    Args:
        capture: with the given cameras.
        dataset: with the cameras to train from.
        seed: of the run.
        name: of the refinement.
        steps: of the run.
    """
    refinement = CAMERA_REFINEMENTS[name]
    recipe = replace(default(steps, room_for(dataset)), seed=seed, camera_refinement=refinement)
    began = time.process_time()
    for progress in sx.optimize(dataset, recipe):
        pass
    seconds = time.process_time() - began
    state = progress.state.train
    ended = refined(refinement, state.cameras, dataset.train, state.extent)
    positions = np.asarray(capture.points.positions)
    before, after = (apart(capture.train, views, positions) for views in (dataset.train, ended))
    given = sx.evaluate(progress.gaussians, dataset.test)
    adjusted = evaluate_adjusted(progress.gaussians, dataset.test)
    return (
        f"{given.psnr:6.2f} dB {given.ssim:.4f}, adjusted poses {adjusted.scores.psnr:.2f} dB "
        f"{adjusted.scores.ssim:.4f}, cameras {before:.3f} px off before and {after:.3f} px after, "
        f"{seconds:.0f} s of CPU"
    )


def main(
    captures: Sequence[str],
    seeds: Sequence[int],
    names: Sequence[str],
    steps: int,
    downscale: int,
    off: float,
) -> None:
    """Prints a line for each run."""
    for capture in captures:
        whole = loaded(capture, downscale)
        for seed in seeds:
            dataset = replace(whole, train=turned(whole.train, off, seed)) if off else whole
            for name in names:
                words = run(whole, dataset, seed, name, steps)
                print(f"{capture.rsplit('/', 1)[-1]:8} seed {seed} {name:8} {words}", flush=True)


if __name__ == "__main__":
    folders, numbers, chosen = (argument.split(",") for argument in sys.argv[1:4])
    given_ = sys.argv[4:]
    total, smaller, away = (float(text) for text in (*given_, *DEFAULTS[len(given_) :]))
    main(folders, [int(number) for number in numbers], chosen, int(total), int(smaller), away)
