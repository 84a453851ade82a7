"""Fuses depth maps of any lens into a volume of truncated signed distances (Curless and Levoy 1996)."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatax.cameras import Camera
from splatax.cameras.geometry import rays, seen_at
from splatax.io.memory import MEMORY_DIVISOR, machine_memory
from splatax.mesh.views import DepthView, Watch, jumps_of, row_major, sampled, unwatched
from splatax.mesh.volume import SIDE, VOXELS, Volume, blocks_around, coordinates_of, empty_volume
from splatax.surfaces import normals_of, positions_of

BATCH = 256  # blocks that are computed at a time
LEAST_COSINE = 0.1  # of the angle at which a surface is seen: more slanted pixels count like this
MOST_BEHIND = 2  # truncations behind a surface, along the ray, at which its slanted pixels still count
OFFSETS = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Fusion:
    """Settings of fusion.

    Attributes:
        voxel: width of a voxel, world units. Distances are cut off at 4 voxels from a surface.
        memory: bytes that the volume may take; None for a quarter of the machine's.
    """

    voxel: float
    memory: int | None = None


def fuse(views: Sequence[DepthView], settings: Fusion, watch: Watch = unwatched) -> Volume:
    """Returns the volume of what the views see.

    Each view is read twice: once to find out where surfaces are, and once to measure distances there.

    Args:
        views: the views.
        settings: width of a voxel, and the limit of memory.
        watch: shows progress over the views.

    Raises:
        InputError: if the volume takes more memory than it may.
    """
    memory = machine_memory() // MEMORY_DIVISOR if settings.memory is None else settings.memory
    keys = np.zeros(0, np.int64)
    for view in watch(views, "finding surfaces"):
        depth = view.read().depth
        seen = np.asarray(positions_of(view.camera, depth), np.float64)[depth > 0]
        keys = np.union1d(keys, blocks_around(one_a_voxel(seen, settings.voxel), settings.voxel))
    volume = empty_volume(settings.voxel, keys, memory)
    for view in watch(views, "fusing depth"):
        integrate(volume, view.camera, view.read().depth)
    return volume


def one_a_voxel(points: Float[np.ndarray, "n 3"], voxel: float) -> Float[np.ndarray, "k 3"]:
    """Returns points of which at most one is in each voxel."""
    cells = np.floor(points / voxel).astype(np.int64)
    return points[np.unique(cells, axis=0, return_index=True)[1]]


def integrate(volume: Volume, camera: Camera, depth: Float[np.ndarray, "h w"]) -> None:
    """Adds the depth map of one view to a volume, in place.

    Voxels farther behind the surface than the truncation are not seen, so the view says nothing of them.
    """
    depths = jnp.asarray(depth, jnp.float32)
    cosines = slants(camera, depths)
    rows = rows_in_view(volume, camera)
    for start in range(0, len(rows), BATCH):
        batch = rows[start : start + BATCH]
        padded = np.resize(batch, BATCH)  # one shape for the compiled program
        places = voxels_of(coordinates_of(volume.keys[padded]), volume.voxel).astype(np.float32)
        seen = _seen(camera, depths, cosines, places.reshape(-1, 3), np.float32(volume.truncation))
        distance, weight, near = (np.asarray(part).reshape(BATCH, VOXELS)[: len(batch)] for part in seen)
        total = volume.weights[batch] + weight
        gain = np.divide(weight, total, out=np.zeros_like(total), where=total > 0)
        volume.distances[batch] += gain * (distance - volume.distances[batch])
        volume.weights[batch] = total
        volume.views[batch] += near


def voxels_of(coordinates: Int[np.ndarray, "n 3"], voxel: float) -> Float[np.ndarray, "n v 3"]:
    """Returns the positions of all voxels of blocks, world units."""
    return (SIDE * coordinates[:, None, :] + OFFSETS[None]) * voxel


def rows_in_view(volume: Volume, camera: Camera) -> Int[np.ndarray, " k"]:
    """Returns the rows of the blocks of which a camera sees the middle or a corner."""
    width = SIDE * volume.voxel
    places = [(0.5, 0.5, 0.5), *np.ndindex(2, 2, 2)]
    inside = np.zeros(len(volume.keys), bool)
    for place in places:
        pixels, _ = seen_at(camera, (volume.coordinates + np.array(place)) * width)
        inside |= np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
    return np.flatnonzero(inside)


@jax.jit
def slants(camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Returns the cosine of the angle between each pixel's ray and the normal of the surface that it sees.

    It is 1 where the normal is unknown or depth jumps, and at least `LEAST_COSINE`.
    """
    cosines = jnp.abs(jnp.sum(normals_of(camera, depth) * rays(camera), axis=-1))
    return jnp.where((cosines > 0) & ~jumps_of(depth), jnp.clip(cosines, LEAST_COSINE, 1), 1)


@jax.jit
def _seen(
    camera: Camera,
    depth: Float[Array, "h w"],
    cosines: Float[Array, "h w"],
    points: Float[Array, "n 3"],
    truncation: Float[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Bool[Array, " n"]]:
    """Returns the distance of each point in front of the surface, divided by the truncation, its weight, and
    whether it is within the truncation."""

    def place_of(point):
        seen = camera.lens.sees(camera.rotation @ point + camera.translation)
        ahead = camera.position + camera.rotation[2]
        local = camera.to_camera(jnp.where(seen, point, ahead))
        pixel, along = camera.to_pixel(local), camera.lens.depth(local)
        stretch = jnp.linalg.norm(local) / along if camera.lens.CENTRAL else jnp.ones_like(along)
        return jnp.where(seen, pixel, -1), along, stretch

    pixels, along, stretch = jax.vmap(place_of)(points)
    surface = sampled(depth, pixels)
    x, y = jnp.clip(pixels[:, 0], 0, camera.width - 1), jnp.clip(pixels[:, 1], 0, camera.height - 1)
    cosine = cosines.ravel()[row_major(x, y, camera.width)]
    before = (surface - along) * stretch / truncation  # along the ray
    distance = before * cosine
    seen = (surface > 0) & (distance > -1) & (before > -MOST_BEHIND)
    return jnp.clip(distance, -1, 1), jnp.where(seen, cosine, 0), seen & (distance < 1)
