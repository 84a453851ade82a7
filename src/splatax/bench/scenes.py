"""Scenes to time, each with a camera that has all of it in view."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from splatax.camera import Camera, look_at
from splatax.gaussians import Gaussians
from splatax.math import harmonics

COVERAGE = 14.0  # Gaussians over a point of a surface; trained scenes have about as many
VIEW = (0.5, 0.2, 1.0)  # direction in which cameras look at scenes
FOCAL = 0.8  # of the longer side of the image


@dataclass(frozen=True)
class Scene:
    """Gaussians, and a view of them."""

    name: str
    gaussians: Gaussians
    camera: Camera


def procedural(count: int, seed: int = 0) -> Gaussians:
    """Flat Gaussians on a ground and on balls over it, with the statistics of a trained scene.

    A scene of more has smaller ones, so the layers over a pixel stay as many. Degree 3, 59 numbers
    a Gaussian.

    Args:
        count: of Gaussians.
        seed: of all randomness.
    """
    rng = np.random.default_rng(seed)
    on_ground = count // 3
    ground = np.column_stack([rng.uniform(-2, 2, (on_ground, 2)), np.full(on_ground, 1.0)])[:, [0, 2, 1]]
    normals = rng.normal(size=(count - on_ground, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    balls = rng.uniform([-1.6, -0.6, -1.6], [1.6, 0.6, 1.6], (12, 3))
    radii = rng.uniform(0.2, 0.6, 12)
    chosen = rng.choice(12, count - on_ground, p=radii**2 / np.sum(radii**2))
    means = np.concatenate([ground, balls[chosen] + radii[chosen, None] * normals])
    area = 16 + np.sum(4 * np.pi * radii**2)
    sigma = np.sqrt(COVERAGE * area / count / (4 * np.pi))
    scales = sigma * np.exp(rng.normal(size=(count, 3)) * 0.6) * rng.permuted([[1, 1, 0.15]] * count, axis=1)
    opacities = np.clip(rng.beta(0.6, 0.9, count), 0.006, 0.995)
    sh = rng.normal(size=(count, harmonics.count(3), 3)) * 0.05
    sh[:, 0] = rng.uniform(-1.2, 1.2, (count, 3))
    fields = (means, rng.normal(size=(count, 4)), np.log(scales), np.log(opacities / (1 - opacities)), sh)
    return Gaussians(*(jnp.asarray(field, jnp.float32) for field in fields))


def whole(gaussians: Gaussians, size: tuple[int, int]) -> Camera:
    """A camera that sees nearly all of a scene.

    Args:
        gaussians: the scene.
        size: width and height, pixels.
    """
    width, height = size
    low, high = np.percentile(np.asarray(gaussians.means, np.float64), [1, 99], axis=0)
    centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    focal = FOCAL * max(size)
    distance = radius / np.sin(np.arctan(min(size) / 2 / focal))
    position = centre - distance * np.array(VIEW) / np.linalg.norm(VIEW)
    pose = look_at(*(jnp.asarray(v, jnp.float32) for v in (position, centre, (0, -1, 0))))
    return Camera.simple_pinhole(focal, pose, width, height)
