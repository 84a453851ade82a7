"""Distances between a mesh and the true surfaces that cameras see."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from splatax.cameras import Camera
from splatax.mesh.record import Mesh
from splatax.surfaces import normals_of, positions_of

POINTS = 50_000  # of the mesh, at which its distance from the truth is measured
MOST_POINTS = 4_000_000  # of the mesh, near which the truth is searched
NEIGHBOURS = 4
SMOOTH = 3.0  # times the pixel's width: neighbours farther away are on another surface
TOLERANCE = 0.05


@dataclass(frozen=True)
class Samples:
    """Points of true surfaces. Each stands for a disc around it.

    Attributes:
        points: positions, world units.
        normals: unit normals.
        radii: radii of the discs, world units.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    radii: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Agreement:
    """Distances between a mesh and the truth.

    Attributes:
        median: median distance of points of the mesh from the truth, world units.
        most: distance that 90 % of the points of the mesh do not exceed, world units.
        precision: fraction of the mesh within the tolerance of the truth.
        completeness: fraction of the truth within the tolerance of the mesh.
        tolerance: world units.
    """

    median: float
    most: float
    precision: float
    completeness: float
    tolerance: float


def samples_of(
    truths: Iterable[tuple[Camera, Float[np.ndarray, "h w"]]], spacing: float | None = None
) -> Samples:
    """Returns points of the surfaces in true depth maps: only of what the cameras see.

    Args:
        truths: cameras and their depth maps, 0 or infinite where there is no surface.
        spacing: least distance between points, world units; None keeps the point of every pixel.
    """
    parts = []
    for camera, depth in truths:
        known = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        points, normals = (np.asarray(f(camera, known), np.float64) for f in (positions_of, normals_of))
        points[known == 0] = np.nan
        radii = np.full(depth.shape, np.nan)
        steps = [np.linalg.norm(points[1:-1, 2:] - points[1:-1, :-2], axis=-1) / 2]
        steps += [np.linalg.norm(points[2:, 1:-1] - points[:-2, 1:-1], axis=-1) / 2]
        radii[1:-1, 1:-1] = np.maximum(*steps)
        pixel = np.nanmedian(np.minimum(*steps)) if np.isfinite(steps).any() else 0.0
        # Differences across an edge of a surface give neither its normal nor its radius.
        kept = (normals != 0).any(axis=-1) & (radii < SMOOTH * max(pixel, 1e-30))
        parts.append(np.column_stack([points[kept], normals[kept], radii[kept]]))
    rows = np.concatenate([*parts, np.zeros((0, 7))])
    if spacing is not None:
        cells = np.floor(rows[:, :3] / spacing).astype(np.int64)
        rows = rows[np.unique(cells, axis=0, return_index=True)[1]]
    return Samples(rows[:, :3], rows[:, 3:6], np.maximum(rows[:, 6], spacing or 0))


def compare(mesh: Mesh, truth: Samples, tolerance: float = TOLERANCE) -> Agreement:
    """Measures the distance of a mesh from true surfaces, and how much of these the mesh covers.

    A distance from the truth is that from the nearest of the discs of its samples.

    Args:
        mesh: with at least one face.
        truth: at least one sample.
        tolerance: distance up to which surfaces count as the same, world units.
    """
    apart = distances(points_on(mesh, POINTS), truth)
    dense = int(np.clip(mesh.areas.sum() / (tolerance / 4) ** 2, POINTS, MOST_POINTS))
    missed = cKDTree(points_on(mesh, dense)).query(truth.points, distance_upper_bound=tolerance)[0]
    return Agreement(
        float(np.median(apart)),
        float(np.percentile(apart, 90)),
        float(np.mean(apart <= tolerance)),
        float(np.mean(missed <= tolerance)),
        tolerance,
    )


def distances(points: Float[np.ndarray, "n 3"], truth: Samples) -> Float[np.ndarray, " n"]:
    """Returns the distance of points from the discs of samples, of which the nearest four are looked at."""
    count = min(NEIGHBOURS, len(truth.points))
    rows = cKDTree(truth.points).query(points, k=count)[1].reshape(len(points), count)
    offsets = points[:, None] - truth.points[rows]
    along = np.sum(offsets * truth.normals[rows], axis=2)
    across = np.linalg.norm(offsets - along[..., None] * truth.normals[rows], axis=2)
    return np.hypot(along, np.maximum(across - truth.radii[rows], 0)).min(axis=1)


def points_on(mesh: Mesh, count: int) -> Float[np.ndarray, "n 3"]:
    """Returns random points on a mesh, evenly spread over its area. The same for each call."""
    faces, weights = places_on(mesh, count)
    return np.sum(mesh.vertices[mesh.faces[faces]] * weights[..., None], axis=1)


def places_on(mesh: Mesh, count: int) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Returns where the points of `points_on` lie: their faces, and the weights of the faces' corners."""
    rng = np.random.default_rng(0)
    areas = mesh.areas
    faces = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.random((2, count))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return faces, np.stack([1 - u - v, u, v], axis=1)
