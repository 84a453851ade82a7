"""Closed meshes for physics."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatax.mesh.coloring import colored
from splatax.mesh.extraction import check, least_views, simplified
from splatax.mesh.fusion import Fusion, fuse
from splatax.mesh.record import Mesh, components_of
from splatax.mesh.resolution import resolution_of
from splatax.mesh.surface import surface_of
from splatax.mesh.views import DepthView, Watch, unwatched
from splatax.mesh.volume import Volume

COLLISION_FACES = 5000
COLLISION_COARSER = 2  # times the voxel that suits the views
THICKNESS = 0.75  # of the truncation, which is 4 voxels
LEAST_VOLUME = 0.001  # of a solid that is kept, as a fraction of that of the largest


def collision_mesh(
    views: Sequence[DepthView],
    voxel: float | None = None,
    *,
    faces: int = COLLISION_FACES,
    memory: int | None = None,
    watch: Watch = unwatched,
) -> Mesh:
    """Returns a small mesh that encloses solid matter, for the collisions of a physics engine.

    Cameras see surfaces and not what is behind them. Solid is what lies up to three voxels behind a surface
    that they see, and every cavity that this encloses: a ball that is seen all around is solid, a wall that
    is seen from one side is a slab of three voxels. The mesh is closed before it is simplified, which may
    leave a few gaps or touching faces. It is not convex, and engines take it as a static triangle mesh.

    Args:
        views: depth and colour, see `depth_views`.
        voxel: width of a voxel, world units; None takes twice that of `resolution_of`.
        faces: the number of faces to simplify to.
        memory: bytes that the volume may take; None for a quarter of the machine's.
        watch: shows progress, such as `rich.progress.track`.

    Raises:
        InputError: in the cases of `extract`.
        MissingPackageError: if a package that makes meshes is not installed.
    """
    check(voxel, faces)
    settings = Fusion(COLLISION_COARSER * resolution_of(views).voxel if voxel is None else voxel, memory)
    volume = slabs(fuse(views, settings, watch), least_views(views))
    mesh = solids(surface_of(volume, watch=watch))
    return colored(simplified(mesh, faces), views, 4 * settings.voxel, watch)


def slabs(volume: Volume, views: int) -> Volume:
    """Returns a volume whose surface encloses what lies close behind the surface of another.

    What fewer than so many views saw counts as empty, so the surface is closed.
    """
    behind = np.maximum(volume.distances, -THICKNESS - volume.distances)
    distances = np.where(volume.views >= views, behind, np.float32(1))
    weights, counts = np.ones_like(volume.weights), np.ones_like(volume.views)
    return replace(volume, distances=distances, weights=weights, views=counts)


def solids(mesh: Mesh) -> Mesh:
    """Returns a closed mesh without the surfaces of cavities, and without its small solids.

    The volume inside a closed surface is negative if its faces look inwards, as those of a cavity do.
    """
    component = components_of(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    volumes = np.bincount(component, np.sum(a * np.cross(b, c), axis=1)) / 6
    return mesh.with_faces((volumes > max(LEAST_VOLUME * volumes.max(), 0))[component])
