"""Colours of a mesh's vertices, from the views that see them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from splatax.cameras.geometry import seen_at
from splatax.mesh.record import Mesh
from splatax.mesh.views import DepthView, Picture, Watch, sampled, unwatched


def colored(mesh: Mesh, views: Sequence[DepthView], reach: float, watch: Watch = unwatched) -> Mesh:
    """Returns the mesh with the mean colour that the views see at each vertex.

    A view counts by the cosine of the angle at which it sees the surface, over the square of the distance. A
    vertex that no view sees takes the colour of the nearest one that some view does.

    Args:
        mesh: the mesh.
        views: the views.
        reach: distance behind the depth of a view, world units, within which a vertex is not hidden.
        watch: shows progress over the views.
    """
    sums, weights, normals = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices)), mesh.normals
    for view in watch(views, "coloring"):
        picture = view.read()
        pixels, depths = seen_at(view.camera, mesh.vertices)
        surface = np.asarray(sampled(picture.depth, np.nan_to_num(pixels, nan=-1.0).astype(np.float32)))
        towards = np.asarray(view.camera.position, np.float64) - mesh.vertices
        distances = np.linalg.norm(towards, axis=1)
        cosines = np.sum(towards * normals, axis=1) / np.maximum(distances, 1e-30)
        seen = np.flatnonzero((surface > 0) & (depths < surface + reach) & (cosines > 0))
        weight = cosines[seen] / distances[seen] ** 2
        sums[seen] += weight[:, None] * between_pixels(picture, pixels[seen])
        weights[seen] += weight
    known = weights > 0
    if not known.any():
        return mesh
    rgb = sums[known] / weights[known, None]
    colors = np.empty_like(mesh.colors)
    colors[known] = np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    if not known.all():
        nearest = cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]
        colors[~known] = colors[known][nearest]
    return replace(mesh, colors=colors)


def between_pixels(picture: Picture, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Returns colours at pixel coordinates, interpolated linearly."""
    places = pixels.T[::-1] - 0.5
    return np.stack(
        [map_coordinates(picture.rgb[..., i], places, order=1, mode="nearest") for i in range(3)], axis=1
    )
