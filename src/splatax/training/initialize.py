"""The first Gaussians: from points of structure from motion, or at random where cameras look."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from splatax.camera import Camera
from splatax.dataset import Dataset
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.math.neighbours import mean_squared_distances
from splatax.projection import NEAR

SMALLEST = 0.01  # of the median distance between neighbours: size of points that coincide


@dataclass(frozen=True)
class FromPoints:
    """A round Gaussian on each point, as large as its neighbours are far (Kerbl et al. 2023).

    Points that stand alone are mostly wrong, and would be the largest Gaussians: they are left out.
    """

    opacity: float = 0.1
    scale: float = 1.0  # times the root mean square distance to the 3 nearest points
    isolation: float = 6.0  # how far is too far: robust standard deviations of the log of that distance

    def number(self, dataset: Dataset) -> int:
        """How many there will be, but for points that stand alone."""
        return len(dataset.points)

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """The start of training on a capture.

        Raises:
            DatasetError: if the capture has no points.
        """
        points = dataset.points
        if not len(points):
            raise DatasetError(
                "The capture has no points to start from. Start at random: --init random, or "
                "Recipe(initialization=InFrusta())."
            )
        kept = ~isolated(points.positions, self.isolation)
        positions, colors = points.positions[kept], points.colors[kept]
        return _round_gaussians(positions, colors, self.opacity, self.scale, sh_degree, dataset.extent)


@dataclass(frozen=True)
class InFrusta:
    """Round Gaussians of random colour, spread over what the training cameras see."""

    count: int = 20_000
    opacity: float = 0.1
    scale: float = 1.0  # times the root mean square distance to the 3 nearest
    nearest: float = 0.3  # of the distance to where the cameras look
    farthest: float = 4.0  # of it; even in inverse depth between

    def number(self, dataset: Dataset) -> int:
        """How many there will be."""
        return self.count

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """The start of training on a capture."""
        rng = np.random.default_rng(seed)
        cameras = [view.camera for view in dataset.train]
        distance = focus_distance(cameras, dataset.extent)
        chosen = rng.integers(len(cameras), size=self.count)
        inverse_depth = rng.uniform(1 / self.farthest, 1 / self.nearest, self.count) / distance
        pixels = rng.uniform(size=(self.count, 2))
        positions = np.empty((self.count, 3), np.float32)
        for index, camera in enumerate(cameras):
            rows = chosen == index
            positions[rows] = unproject(camera, pixels[rows], 1 / inverse_depth[rows])
        colors = rng.uniform(size=(self.count, 3)).astype(np.float32)
        return _round_gaussians(positions, colors, self.opacity, self.scale, sh_degree, dataset.extent)


def isolated(positions: Float[np.ndarray, "n 3"], deviations: float) -> Bool[np.ndarray, " n"]:
    """Which points stand alone: their neighbours are far by the measure of all points, 10 times as far at
    least as is usual."""
    distances = np.sqrt(mean_squared_distances(positions))
    apart = np.log(distances[distances > 0])
    if not len(apart):
        return np.zeros(len(positions), bool)
    usual = np.median(apart)
    spread = 1.4826 * np.median(np.abs(apart - usual))  # the standard deviation, if they were normal
    return distances > np.exp(usual + max(deviations * spread, math.log(10)))


def require_visible(gaussians: Gaussians, dataset: Dataset) -> None:
    """Makes sure that there is something to learn from.

    Raises:
        DatasetError: if no Gaussian is in front of a training camera: nothing would ever move.
    """
    means = np.asarray(gaussians.means)
    for view in dataset.train:
        depths = means @ np.asarray(view.camera.rotation)[2] + np.asarray(view.camera.translation)[2]
        if (depths > NEAR).any():
            return
    raise DatasetError(
        f"No camera sees any of the {len(means):,} points to start from: all are behind the cameras, or "
        f"nearer than {NEAR} world units. Check that the points belong to the cameras; scale up a capture "
        "that is so small."
    )


def focus_distance(cameras: list[Camera], extent: float) -> float:
    """How far the cameras look: the median distance to the point nearest to all optical axes.

    Where axes are nearly parallel that point is nowhere in particular; it is then taken within 1
    to 10 extents of the scene.
    """
    rotations = np.stack([np.asarray(camera.rotation, np.float64) for camera in cameras])
    positions = np.stack([np.asarray(camera.position, np.float64) for camera in cameras])
    axes = rotations[:, 2]
    # Least squares over projections onto the planes across each axis.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, positions), rcond=None)[0]
    distance = float(np.median(np.einsum("ni,ni->n", focus - positions, axes)))
    return float(np.clip(distance, extent, 10 * extent))


def unproject(
    camera: Camera, fractions: Float[np.ndarray, "n 2"], depths: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """World points at fractions of the image and at camera depths."""
    pixels = fractions * [camera.width, camera.height]
    slopes = (pixels - [float(camera.cx), float(camera.cy)]) / [float(camera.fx), float(camera.fy)]
    local = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) * depths[:, None]
    rotation, translation = (
        np.asarray(camera.rotation, np.float64),
        np.asarray(camera.translation, np.float64),
    )
    return ((local - translation) @ rotation).astype(np.float32)


def _round_gaussians(
    positions: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    opacity: float,
    scale: float,
    sh_degree: int,
    extent: float,
) -> Gaussians:
    distances = np.sqrt(mean_squared_distances(positions))
    apart = distances[distances > 0]
    typical = float(np.median(apart)) if len(apart) else SMALLEST * extent
    sizes = scale * np.maximum(distances, SMALLEST * typical)
    n = len(positions)
    sh = np.zeros((n, harmonics.count(sh_degree), 3), np.float32)
    sh[:, 0] = harmonics.from_rgb(colors)
    return Gaussians(
        means=jnp.asarray(positions, jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (n, 1)),
        log_scales=jnp.asarray(np.repeat(np.log(sizes)[:, None], 3, axis=1), jnp.float32),
        opacity_logits=jnp.full(n, np.log(opacity / (1 - opacity)), jnp.float32),
        sh=jnp.asarray(sh),
    )
