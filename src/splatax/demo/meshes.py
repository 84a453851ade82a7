"""Photos of triangle meshes: a z-buffer in NumPy, with several samples for each pixel.

Surfaces have their own colour and no light, so that a surface point looks the same in every pose.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, UInt8

from splatax.cameras import Camera
from splatax.cameras.lenses import Pinhole

SAMPLES = 3  # per side of a pixel
TILE = 8  # samples per side of the squares in which triangles are drawn

Texture = Callable[[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]], Float[np.ndarray, "p 3"]]


def photograph_mesh(
    camera: Camera,
    posed: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    bound: Float[np.ndarray, "v 3"],
    colors: Float[np.ndarray, "v 3"],
    texture: Texture,
) -> UInt8[np.ndarray, "h w 4"]:
    """Returns the photo of a mesh on transparent ground: RGB with straight alpha.

    Args:
        camera: a pinhole.
        posed: vertices in the world.
        triangles: indices of their corners; both sides are visible.
        bound: vertices in the bound pose, to which the texture sticks.
        colors: of the vertices, RGB in [0, 1].
        texture: returns the colour of surface points, from their places in the bound pose and the mesh's
            colours.

    Raises:
        ValueError: if the camera is no pinhole, or a vertex is not in front of it.
    """
    if not isinstance(camera.lens, Pinhole):
        raise ValueError(f"meshes are photographed by pinholes, not by {type(camera.lens).__name__}")
    pose = np.asarray(camera.cam_from_world, np.float64)
    local = posed @ pose[:3, :3].T + pose[:3, 3]
    if local[:, 2].min(initial=np.inf) <= 0:
        raise ValueError("a vertex of the mesh is beside or behind the camera: move the camera away")
    focal = np.array([float(camera.fx), float(camera.fy)])
    centre = np.array([float(camera.cx), float(camera.cy)])
    pixels = SAMPLES * (local[:, :2] / local[:, 2:] * focal + centre)
    width, height = SAMPLES * camera.width, SAMPLES * camera.height
    hit, weights = _nearest(pixels, local[:, 2], triangles, (width, height))
    seen = hit >= 0
    corners = triangles[hit[seen]]
    places, own = (np.einsum("pk,pkc->pc", weights[seen], rows[corners]) for rows in (bound, colors))
    image = np.zeros((height * width, 4))
    image[seen, :3] = np.clip(texture(places, own), 0, 1)
    image[seen, 3] = 1
    image = image.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 4).mean(axis=(1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
    return np.round(255 * image).astype(np.uint8)


def _nearest(
    pixels: Float[np.ndarray, "v 2"],
    depths: Float[np.ndarray, " v"],
    triangles: Int[np.ndarray, "t 3"],
    size: tuple[int, int],
) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, "p 3"]]:
    """Returns the nearest triangle at each sample, -1 without one, and the weights of its corners there."""
    owners, squares = _squares(pixels[triangles], size)
    inside = np.arange(TILE) + 0.5
    x = squares[:, 0, None, None] + inside[None, None, :]
    y = squares[:, 1, None, None] + inside[None, :, None]
    (ax, ay), (bx, by), (cx, cy) = pixels[triangles[owners]].transpose(1, 2, 0)[..., None, None]
    doubled = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    doubled = np.where(np.abs(doubled) > 1e-12, doubled, np.inf)
    b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / doubled
    c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / doubled
    screen = np.stack([1 - b - c, b, c], axis=-1)
    met = (screen >= 0).all(axis=-1) & np.isfinite(doubled) & (x < size[0]) & (y < size[1])
    index = np.nonzero(met)
    owner = owners[index[0]]
    weights = screen[index] / depths[triangles[owner]]  # linear in space, not on the image
    inverse = weights.sum(axis=1)
    place = (np.floor(np.broadcast_to(y, met.shape)[index]) * size[0]).astype(np.int64)
    place += np.floor(np.broadcast_to(x, met.shape)[index]).astype(np.int64)
    order = np.argsort(inverse, kind="stable")  # the nearest is written last
    hit, kept = np.full(size[0] * size[1], -1), np.zeros((size[0] * size[1], 3))
    hit[place[order]] = owner[order]
    kept[place[order]] = (weights / inverse[:, None])[order]
    return hit, kept


def _squares(
    corners: Float[np.ndarray, "t 3 2"], size: tuple[int, int]
) -> tuple[Int[np.ndarray, " s"], Int[np.ndarray, "s 2"]]:
    """Returns the squares that triangles may touch: the triangle's index, and the corner of the square."""
    low = np.clip(np.floor(corners.min(axis=1) / TILE), 0, None).astype(np.int64)
    limits = (np.array(size) + TILE - 1) // TILE
    high = np.minimum(np.floor(corners.max(axis=1) / TILE).astype(np.int64) + 1, limits)
    spans = np.maximum(high - low, 0)
    counts = spans.prod(axis=1)
    owners = np.repeat(np.arange(len(corners)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    wide = spans[owners, 0]
    steps = np.stack([within % np.maximum(wide, 1), within // np.maximum(wide, 1)], axis=1)
    return owners, TILE * (low[owners] + steps)
