"""Scenes to time, each with a camera that sees all of it."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera
from splatax.cameras.lenses import Lens, Pinhole
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.trajectories.shapes import FOCAL, overview

LAYERS = 14.0  # Gaussians that cover each point of a surface, about as in trained scenes


@dataclass(frozen=True)
class Scene:
    """Gaussians with a camera."""

    name: str
    gaussians: Gaussians
    camera: Camera
    procedural: bool = False


def procedural(count: int, size: tuple[int, int], seed: int = 0, lens: Lens = Pinhole()) -> Scene:
    """Returns a wavy sheet of flat Gaussians that fills the image, with the statistics of a trained scene.

    The size of the Gaussians decreases with their number, so the number of layers over a pixel stays
    the same. The SH degree is 3, which is 59 numbers per Gaussian.

    Args:
        count: number of Gaussians.
        size: width and height of the image, pixels.
        seed: random seed.
        lens: of the camera, in front of which the sheet lies.
    """
    rng = np.random.default_rng(seed)
    focal = FOCAL * max(size)
    half = np.array(size) / focal / 2  # half the width and height of the image on a plane at distance 1
    x, y = rng.uniform(-1.05 * half, 1.05 * half, (count, 2)).T
    z = 1 + 0.1 * np.sin(9 * x + 4 * y) * np.cos(7 * y) + rng.normal(size=count) * 0.02
    sigma = np.sqrt(LAYERS * 4 * half.prod() / count / (4 * np.pi))
    flat = rng.permuted([[1, 1, 0.15]] * count, axis=1)
    scales = sigma * np.exp(rng.normal(size=(count, 3)) * 0.6) * flat
    opacities = np.clip(rng.beta(0.6, 0.9, count), 0.006, 0.995)
    sh = rng.normal(size=(count, harmonics.count(3), 3)) * 0.05
    sh[:, 0] = rng.uniform(-1.2, 1.2, (count, 3))
    fields = (
        np.column_stack([x, y, z]),
        rng.normal(size=(count, 4)),
        np.log(scales),
        np.log(opacities / (1 - opacities)),
        sh,
    )
    gaussians = Gaussians(*(jnp.asarray(field, jnp.float32) for field in fields))
    camera = replace(Camera.simple_pinhole(focal, jnp.eye(4), *size), lens=lens)
    return Scene(f"{count:,} procedural", gaussians, camera, procedural=True)


def framed(name: str, gaussians: Gaussians, nearness: float, size: tuple[int, int]) -> Scene:
    """Returns a scene with a camera outside it.

    The SH degree is at least 3, with zeros for missing harmonics, so that a training step takes as
    much work as in training.

    Args:
        name: name of the scene.
        gaussians: the Gaussians.
        nearness: 1 places the camera so that nearly all of the scene is in the image; 3 places it at
            a third of that distance.
        size: width and height of the image, pixels.
    """
    camera = overview(np.asarray(gaussians.means), size, nearness)
    missing = max(harmonics.count(3) - gaussians.sh.shape[1], 0)
    gaussians = replace(gaussians, sh=jnp.pad(gaussians.sh, [(0, 0), (0, missing), (0, 0)]))
    return Scene(name, gaussians, camera)
