"""Initialization: the first Gaussians, from the capture's points or at random in front of the cameras."""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from splatax.cameras import Camera, rig
from splatax.cameras.geometry import points_at, seen_at
from splatax.cameras.lenses.protocol import NEAR
from splatax.dataset import Block, Dataset
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians, joined
from splatax.math import harmonics
from splatax.math.neighbours import mean_squared_distances
from splatax.training.protocols import Initialization

SMALLEST = 0.01  # size of Gaussians on coincident points, as a fraction of the median neighbour distance


@dataclass(frozen=True)
class FromPoints:
    """Places a round Gaussian on each point, as large as the distance to its neighbours (Kerbl et al. 2023).

    Isolated points are left out: most are wrong matches, and they would become the largest Gaussians.
    """

    opacity: float = 0.1
    scale: float = 1.0  # size, as a multiple of the root mean square distance to the 3 nearest points
    isolation: float = (
        6.0  # robust standard deviations of the log of that distance; points farther apart are left out
    )

    def number(self, dataset: Dataset) -> int:
        """Returns the number of points, isolated ones included."""
        return len(dataset.points)

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """Returns a Gaussian for each point that is not isolated.

        Raises:
            DatasetError: if the capture has no points.
        """
        points = dataset.points
        if not len(points):
            raise DatasetError(
                "The capture has no points to start from. Find some: "
                "replace(dataset, points=reconstruction.triangulated(dataset.train)). Or start from random "
                "Gaussians: Recipe(initialization=InFrusta())."
            )
        kept = ~isolated(points.positions, self.isolation)
        positions, colors = points.positions[kept], points.colors[kept]
        return _round_gaussians(positions, colors, self.opacity, self.scale, sh_degree, dataset.extent)


@dataclass(frozen=True)
class InFrusta:
    """Places round Gaussians of random colour at random in the frusta of the training cameras."""

    count: int = 20_000
    opacity: float = 0.1
    scale: float = 1.0  # size, as a multiple of the root mean square distance to the 3 nearest
    nearest: float = 0.3  # depth, as a fraction of the distance that the cameras look at
    farthest: float = 4.0  # depth, as a multiple of it; uniform in inverse depth between

    def number(self, dataset: Dataset) -> int:
        """Returns the number of Gaussians."""
        return self.count

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """Returns Gaussians of random positions and colours."""
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


@dataclass(frozen=True)
class Discs:
    """Makes exactly flat Gaussians of those of another initialization, in random directions (2DGS).

    Attributes:
        start: places them.
    """

    start: Initialization

    def number(self, dataset: Dataset) -> int:
        """Returns the number of Gaussians that `start` has."""
        return self.start.number(dataset)

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """Returns the Gaussians with a third scale of zero.

        Raises:
            DatasetError: if the capture lacks what they are made from.
        """
        gaussians = self.start(dataset, sh_degree, seed)
        quats = np.random.default_rng(seed).normal(size=(len(gaussians), 4))
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        flat = gaussians.log_scales.at[:, 2].set(-jnp.inf)
        return replace(gaussians, quats=jnp.asarray(quats, jnp.float32), log_scales=flat)


@dataclass(frozen=True)
class WithSky:
    """Adds Gaussians on a sphere far around the cameras, for open scenes: there are no points in the sky.

    Attributes:
        start: initialization of the rest of the scene.
        count: number of Gaussians on the whole sphere; only those are added that a training camera sees.
        radius: radius of the sphere, in extents of the scene.
        opacity: opacity of the added Gaussians.
        scale: size, as a multiple of the root mean square distance to the 3 nearest.
    """

    start: Initialization
    count: int = 500
    radius: float = 30.0
    opacity: float = 0.5
    scale: float = 0.5

    def number(self, dataset: Dataset) -> int:
        """Returns about how many Gaussians there will be: as many as `start` has, and the whole sphere."""
        return self.start.number(dataset) + self.count

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """Returns the Gaussians of `start`, then grey ones on the sphere.

        Raises:
            DatasetError: if the capture lacks what those of `start` are made from, or no camera sees them.
        """
        start, cameras = self.start(dataset, sh_degree, seed), [view.camera for view in dataset.train]
        require_visible(start, dataset)  # those of the sky are always visible
        centre = rig.positions_of(cameras).mean(axis=0)
        sphere = centre + self.radius * dataset.extent * evenly_on_sphere(self.count).astype(np.float32)
        grey = np.full_like(sphere, 0.5)
        sky = _round_gaussians(sphere, grey, self.opacity, self.scale, sh_degree, dataset.extent)
        seen = seen_by_any(cameras, sphere)
        return joined([start, jax.tree.map(lambda leaf: leaf[seen], sky)]) if seen.any() else start


@dataclass(frozen=True)
class FromBlock:
    """Starts from the Gaussians that a block of a larger scene has in a coarse run; see `splatax.blocks`.

    Attributes:
        plan: digest of the plan that cut the scene, so that runs of different plans have different recipes.
        index: number of the block in the plan.
    """

    plan: str
    index: int

    def number(self, dataset: Dataset) -> int:
        """Returns the number of Gaussians."""
        return len(_block_of(dataset).start)

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """Returns the coarse Gaussians of the block; harmonics that they lack are zeros.

        Raises:
            DatasetError: if the capture is not that of a block, or they have more harmonics than the recipe.
        """
        start = _block_of(dataset).start
        if start.sh_degree > sh_degree:
            raise DatasetError(
                f"The coarse scene has colours of SH degree {start.sh_degree}, the recipe of {sh_degree}. "
                "Reduce those of the scene first (splatax.editing.reduce_degree, or splatax export)."
            )
        more = harmonics.count(sh_degree) - start.sh.shape[1]
        padded = jnp.pad(start.sh, ((0, 0), (0, more), (0, 0)))
        return replace(start, sh=padded, low_pass=Gaussians.low_pass, order=Gaussians.order)


def with_sky(start: Initialization) -> Initialization:
    """Returns an initialization that also places Gaussians in the sky. For `Discs`, they are discs too."""
    if isinstance(start, Discs):
        return replace(start, start=with_sky(start.start))
    return WithSky(start)


def _block_of(dataset: Dataset) -> Block:
    if dataset.block is None:
        raise DatasetError("The recipe starts from a block, but the capture is a whole one.")
    return dataset.block


def isolated(positions: Float[np.ndarray, "n 3"], deviations: float) -> Bool[np.ndarray, " n"]:
    """Returns which points are isolated.

    A point is isolated if the distance to its neighbours exceeds the median of all points by this many robust
    standard deviations of its logarithm, and by a factor of 10.
    """
    distances = np.sqrt(mean_squared_distances(positions))
    apart = np.log(distances[distances > 0])
    if not len(apart):
        return np.zeros(len(positions), bool)
    usual = np.median(apart)
    spread = 1.4826 * np.median(
        np.abs(apart - usual)
    )  # equals the standard deviation of a normal distribution
    return distances > np.exp(usual + max(deviations * spread, math.log(10)))


def require_visible(gaussians: Gaussians, dataset: Dataset) -> None:
    """Checks that at least one Gaussian is in front of a training camera.

    Raises:
        DatasetError: if none is: no Gaussian would ever get a gradient.
    """
    means = np.asarray(gaussians.means)
    for view in dataset.train:
        if np.isfinite(seen_at(view.camera, means)[1]).any():
            return
    raise DatasetError(
        f"No camera sees any of the {len(means):,} points to start from: all are behind the cameras, or "
        f"nearer than {NEAR} world units. Check that the points belong to the cameras; scale up a capture "
        "that is so small."
    )


def evenly_on_sphere(count: int) -> Float[np.ndarray, "n 3"]:
    """Returns unit vectors that are spread evenly: points of a Fibonacci lattice."""
    places = np.arange(count) + 0.5
    z, turn = 1 - 2 * places / count, math.pi * (1 + math.sqrt(5)) * places
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def seen_by_any(cameras: list[Camera], points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Returns which world points lie in the image of at least one camera, even if others hide them."""
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        pixels, _ = seen_at(camera, points)  # NaN where the lens does not see them
        seen |= ((pixels >= 0) & (pixels < np.asarray(camera.size))).all(axis=1)
    return seen


def focus_distance(cameras: list[Camera], extent: float) -> float:
    """Returns the median distance of the cameras to the point nearest to all optical axes, world units.

    The point is ill-defined if the axes are nearly parallel, so the distance is clipped to 1 to 10 extents
    of the scene.
    """
    offsets = rig.nearest_to_axes(cameras) - rig.positions_of(cameras)
    distance = float(np.median(np.einsum("ni,ni->n", offsets, rig.axes_of(cameras))))
    return float(np.clip(distance, extent, 10 * extent))


def unproject(
    camera: Camera, fractions: Float[np.ndarray, "n 2"], depths: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Returns world points at fractions of the image and at camera depths."""
    pixels = fractions * [camera.width, camera.height]
    return points_at(camera, pixels, depths).astype(np.float32)


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
