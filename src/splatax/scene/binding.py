"""Binding: which joints each Gaussian follows, from the surface of a body."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.scene.body import Body, Surface, strongest
from splatax.scene.skin import Rig

SAMPLES = 200_000  # points on the surface that stand for all of it
CHUNK = 1 << 14  # points whose weights are summed at a time
FAR = 0.1  # distance to the surface, as a fraction of the body's size, from which a Gaussian counts as far


def sampled(surface: Surface, count: int, seed: int = 0) -> Surface:
    """Returns points spread evenly over a surface, as vertices without triangles.

    Raises:
        InputError: if the surface has no area.
    """
    corners = surface.vertices[surface.triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not areas.sum() > 0:
        raise InputError("the surface of the body has no area. Give a body with triangles.")
    rng = np.random.default_rng(seed)
    # Equal steps along the summed areas spread the points more evenly than independent draws.
    steps = (np.arange(count) + rng.uniform(size=count)) / count
    chosen = np.searchsorted(np.cumsum(areas) / areas.sum(), steps).clip(0, len(areas) - 1)
    corner_weights = rng.dirichlet(np.ones(3), count)
    triangle = surface.triangles[chosen]
    vertices, colors = (
        np.einsum("pk,pkc->pc", corner_weights, rows[triangle]) for rows in (surface.vertices, surface.colors)
    )
    indices = surface.indices[triangle].reshape(count, -1)
    weights = (corner_weights[:, :, None] * surface.weights[triangle]).reshape(count, -1)
    merged = [_merged(indices[i : i + CHUNK], weights[i : i + CHUNK]) for i in range(0, count, CHUNK)]
    indices, weights = (np.concatenate(rows) for rows in zip(*merged, strict=True))
    return Surface(vertices, np.zeros((0, 3), np.int64), indices, weights, colors)


def bind(gaussians: Gaussians, body: Body) -> Rig:
    """Returns a rig in which each Gaussian follows the joints of the surface point nearest to it.

    Broken Gaussians follow the joints of any point.

    Args:
        gaussians: a scene in the coordinates and the bound pose of the body.
        body: its skeleton and surface.

    Raises:
        InputError: if most Gaussians are far from the surface: the two do not fit together.
    """
    points = sampled(body.surface, SAMPLES)
    means = np.asarray(gaussians.means, np.float64)
    known = np.asarray(np.isfinite(means).all(axis=1))
    distances, nearest = cKDTree(points.vertices).query(np.where(known[:, None], means, 0))
    size = float(np.ptp(body.surface.vertices, axis=0).max())
    if known.any() and np.median(distances[known]) > FAR * size:
        apart = np.median(distances[known]) / size
        raise InputError(
            f"most Gaussians are {apart:.2f} times the size of the body away from its surface: the scan and "
            "the body do not fit together. Move, turn and scale the scan into the "
            "body's place first (splatax.editing, or splatax export)."
        )
    return _rig(body, points.indices[nearest], points.weights[nearest])


def covering(
    body: Body, count: int, opacity: float = 0.5, sh_degree: int = 0, seed: int = 0
) -> tuple[Gaussians, Rig]:
    """Returns round Gaussians that cover the surface of a body, and their rig.

    Args:
        body: its skeleton and surface.
        count: number of Gaussians.
        opacity: of each.
        sh_degree: degree of the spherical harmonics; the colour is that of the surface from all sides.
        seed: of the places on the surface.

    Raises:
        InputError: if the surface has no area.
    """
    corners = body.surface.vertices[body.surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    width = np.sqrt(np.linalg.norm(normals, axis=1).sum() / 2 / count)
    points = sampled(body.surface, count, seed)
    sh = np.zeros((count, harmonics.count(sh_degree), 3), np.float32)
    sh[:, 0] = harmonics.from_rgb(points.colors)
    gaussians = Gaussians(
        jnp.asarray(points.vertices, jnp.float32),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        jnp.full((count, 3), np.log(0.6 * width), jnp.float32),
        jnp.full(count, np.log(opacity / (1 - opacity)), jnp.float32),
        jnp.asarray(sh),
    )
    return gaussians, _rig(body, points.indices, points.weights)


def _rig(body: Body, indices: Int[np.ndarray, "n k"], weights: Float[np.ndarray, "n k"]) -> Rig:
    return Rig(body.skeleton, jnp.asarray(indices, jnp.int32), jnp.asarray(weights, jnp.float32))


def _merged(
    indices: Int[np.ndarray, "p m"], weights: Float[np.ndarray, "p m"]
) -> tuple[Int[np.ndarray, "p k"], Float[np.ndarray, "p k"]]:
    """Adds up the weights of equal joints, and keeps the strongest."""
    dense = np.zeros((len(indices), int(indices.max(initial=0)) + 4))
    np.add.at(dense, (np.arange(len(indices))[:, None], indices), weights)
    every = np.broadcast_to(np.arange(dense.shape[1]), dense.shape)
    kept, fractions = strongest(every, dense)
    return np.where(fractions > 0, kept, kept[:, :1]), fractions
