"""Meshes from the views of a scene: all steps, one after the other."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from splatax.errors import InputError
from splatax.mesh.coloring import colored
from splatax.mesh.fusion import Fusion, fuse
from splatax.mesh.needed import needed
from splatax.mesh.record import Mesh, largest_components
from splatax.mesh.resolution import resolution_of
from splatax.mesh.surface import surface_of
from splatax.mesh.views import DepthView, Watch, unwatched

LEAST_COMPONENT = 0.01  # area of a part that is kept, as a fraction of that of the largest
LEAST_VIEWS = 3  # a surface that fewer views see is often fog in front of that camera
LEAST_FACES = 4
MOST_KEPT = 0.95  # fraction of faces; a pass that keeps more of them is the last one


def extract(
    views: Sequence[DepthView],
    voxel: float | None = None,
    *,
    faces: int | None = None,
    memory: int | None = None,
    watch: Watch = unwatched,
) -> Mesh:
    """Returns a coloured mesh of the surfaces that views see.

    It ends where nothing was seen, so it has a border and no back. Parts with less than a hundredth of the
    area of the largest are removed.

    Args:
        views: depth and colour, see `depth_views`.
        voxel: width of a voxel, world units: details that are smaller are lost. None takes that of
            `resolution_of`.
        faces: the number of faces to simplify to; None keeps all, about two for each voxel that the surface
            passes through.
        memory: bytes that the volume may take; None for a quarter of the machine's.
        watch: shows progress, such as `rich.progress.track`.

    Raises:
        InputError: if no view sees a surface, the voxel is no length, there are too few faces, or the volume
            takes more memory than it may.
        MissingPackageError: if a package that makes meshes is not installed.
    """
    check(voxel, faces)
    settings = Fusion(resolution_of(views).voxel if voxel is None else voxel, memory)
    mesh = surface_of(fuse(views, settings, watch), least_views(views), watch)
    mesh = largest_components(mesh, LEAST_COMPONENT)
    if faces is not None:
        mesh = simplified(mesh, faces)
    return colored(mesh, views, 4 * settings.voxel, watch)


def least_views(views: Sequence[DepthView]) -> int:
    """Returns how many of the views must agree on a surface: three, if there are as many."""
    return min(LEAST_VIEWS, len(views))


def check(voxel: float | None, faces: int | None) -> None:
    """Checks the width of a voxel, the number of faces, and that the packages that make meshes are there.

    Raises:
        InputError: if the width is not above zero, or there are fewer faces than a closed surface has.
        MissingPackageError: if a package is not installed.
    """
    needed()
    if voxel is not None and not 0 < voxel < np.inf:
        raise InputError(f"The width of a voxel must be above 0, not {voxel}.", options=("voxel",))
    if faces is not None and faces < LEAST_FACES:
        raise InputError(
            f"The number of faces must be at least {LEAST_FACES}, not {faces}.", options=("faces",)
        )


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Returns the mesh with about this many faces, by collapsing edges (Garland and Heckbert 1997).

    Colours are those of the nearest vertices before. A mesh with fewer faces stays as it is. One with many
    borders, such as a sheet with holes, keeps more faces: those that cannot go without moving the borders.

    Raises:
        MissingPackageError: if a package that makes meshes is not installed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    vertices, triangles = mesh.vertices, mesh.faces.astype(np.int32)
    kept = 0.0
    while len(triangles) > faces and kept < MOST_KEPT:  # each pass spares borders as they are when it begins
        before = len(triangles)
        vertices, triangles = needed().simplify(vertices, triangles, target_count=faces)
        kept = len(triangles) / before
    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    whole = Mesh(vertices, np.asarray(triangles, np.int64), mesh.colors[nearest])
    return whole.with_faces(whole.areas > 0)
