"""Scenes to time, each with a camera that has all of it in view."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from splatax.camera import Camera, look_at
from splatax.gaussians import Gaussians
from splatax.math import harmonics

LAYERS = 14.0  # Gaussians over a point of a surface; trained scenes have about as many
VIEW = (0.5, 0.2, 1.0)  # direction in which the camera looks at a whole scene
FOCAL = 0.8  # of the longer side of the image


@dataclass(frozen=True)
class Scene:
    """Gaussians, and a view of them."""

    name: str
    gaussians: Gaussians
    camera: Camera
    procedural: bool = False


def procedural(count: int, size: tuple[int, int], seed: int = 0) -> Scene:
    """A wavy sheet of flat Gaussians that fills the image, with the statistics of a trained scene.

    A scene of more has smaller ones, so the layers over a pixel stay as many. Degree 3, so 59
    numbers a Gaussian.

    Args:
        count: of Gaussians.
        size: of the image: width and height, pixels.
        seed: of all randomness.
    """
    rng = np.random.default_rng(seed)
    focal = FOCAL * max(size)
    half = np.array(size) / focal / 2  # of the image, on a plane at distance 1
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
    camera = Camera.simple_pinhole(focal, jnp.eye(4), *size)
    return Scene(f"{count:,} procedural", gaussians, camera, procedural=True)


def framed(name: str, gaussians: Gaussians, nearness: float, size: tuple[int, int]) -> Scene:
    """A scene from a distance, with SH up to degree 3 at least: zero where the file has none, so that
    a step is as much work as in training.

    Args:
        name: of the scene.
        gaussians: in it.
        nearness: 1 is so far that nearly all of it is in the image; 3, a third as far.
        size: of the image: width and height, pixels.
    """
    low, high = np.percentile(np.asarray(gaussians.means, np.float64), [1, 99], axis=0)
    centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    focal = FOCAL * max(size)
    distance = radius / np.sin(np.arctan(min(size) / 2 / focal)) / nearness
    position = centre - distance * np.array(VIEW) / np.linalg.norm(VIEW)
    pose = look_at(*(jnp.asarray(v, jnp.float32) for v in (position, centre, (0, -1, 0))))
    missing = max(harmonics.count(3) - gaussians.sh.shape[1], 0)
    gaussians = replace(gaussians, sh=jnp.pad(gaussians.sh, [(0, 0), (0, missing), (0, 0)]))
    return Scene(name, gaussians, Camera.simple_pinhole(focal, pose, *size))
