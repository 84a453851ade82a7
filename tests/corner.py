"""Photos of the corner of a papered room, as a pinhole sees them: enough detail for features, and depth."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from scipy import ndimage

from splatax.cameras.lenses import Lens, Pinhole

SIZE, FOCAL = (400, 300), 380.0
EQUIVALENT = FOCAL * np.hypot(36, 24) / np.hypot(*SIZE)  # mm, as EXIF tells it
COUNT = 8


def wallpaper(seed: int = 3) -> np.ndarray:
    """Spots of all sizes, in [0, 255]."""
    rng = np.random.default_rng(seed)
    noise = [(s, rng.normal(size=(900, 1400, 3))) for s in (1.5, 3, 6, 12)]
    pattern = sum(s * ndimage.gaussian_filter(layer, (s, s, 0)) for s, layer in noise)
    return np.clip(128 + 55 * pattern / pattern.std(), 0, 255)


def positions(count: int = COUNT) -> np.ndarray:
    """Of the cameras, which are turned towards the corner."""
    rng = np.random.default_rng(5)
    return np.column_stack([np.linspace(-1.2, 1.2, count), *rng.uniform(-0.25, 0.25, (2, count))])


def photograph(position, paper, lens: Lens = Pinhole()) -> np.ndarray:
    """Walls at z = 6 - 0.8 |x|, papered by x and y."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2, np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2)
    px, py, pz = position
    angle = np.arctan2(-px, 6)
    x, y, z = x / FOCAL, y / FOCAL, np.ones_like(x)
    if not isinstance(lens, Pinhole):
        places = jnp.asarray(np.stack([x, y], axis=-1).reshape(-1, 2), jnp.float32)
        rays = np.asarray(jax.vmap(lambda place: lens.unproject(place, jnp.float32(1)))(places), np.float64)
        x, y, z = (rays[:, axis].reshape(x.shape) / rays[:, 2].reshape(x.shape) for axis in range(3))
    x, z = x * np.cos(angle) + z * np.sin(angle), z * np.cos(angle) - x * np.sin(angle)
    hits = [(6 - pz - sign * 0.8 * px) / (z + sign * 0.8 * x) for sign in (1, -1)]
    depth = np.minimum(*(np.where(hit > 0, hit, np.inf) for hit in hits))
    at = [(py + depth * y) * 130 + 450, (px + depth * x) * 130 + 700]
    return np.stack([ndimage.map_coordinates(paper[..., c], at, order=1, mode="mirror") for c in range(3)], 2)


def write_photos(folder: Path, exif: bool = True) -> Path:
    folder.mkdir(parents=True)
    paper = wallpaper()
    for i, position in enumerate(positions()):
        tags = Image.Exif()
        if exif:
            tags.get_ifd(0x8769)[0xA405] = round(float(EQUIVALENT))
        image = Image.fromarray(photograph(position, paper).astype(np.uint8))
        image.save(folder / f"wall {i}.jpg", exif=tags, quality=95)
    return folder
