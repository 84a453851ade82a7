"""Data set of the still life in memory: cameras around it, photos and surface points."""

from functools import cache, partial
from itertools import count
from math import gcd

import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera, look_at
from splatax.dataset import Dataset, Pixels, PointCloud, View, hold_out
from splatax.demo.raycast import look, photograph
from splatax.splits import Every, Nothing

PHOTOS = 24
SIZE = (160, 120)  # pixels
FOCAL = 175.0  # pixels, for photos of that size
POINTS = 3000
TARGET = np.array([-0.1, 0.05, 0.35])
AZIMUTHS = (-30.0, 70.0)  # degrees from the back wall's normal; further left is behind the other wall
ELEVATIONS = (14.0, 30.0, 46.0)  # degrees
DISTANCE = 2.7
HELD_OUT = Every(first=1)  # these lie between others


def demo_dataset(photos: int = PHOTOS, width: int = SIZE[0], height: int = SIZE[1]) -> Dataset:
    """Returns a small capture of a procedural still life, without reading or writing files.

    The cameras and the points are exact. Every 8th photo is held out, from the first. A photo is ray traced
    when its `pixels` is called for the first time.

    Args:
        photos: number of photos, at least 1.
        width: width of a photo, pixels. The horizontal field of view does not depend on it.
        height: height of a photo, pixels.

    Raises:
        ValueError: if there is no photo, or a photo has no pixel.
    """
    if min(photos, width, height) < 1:
        raise ValueError(f"a capture needs photos with pixels, not {photos} of {width} x {height} pixels")
    views = [
        View(f"view{i:02}.png", camera, cache(partial(_pixels, camera)))
        for i, camera in enumerate(cameras(photos, (width, height)))
    ]
    rule = HELD_OUT if photos > 1 else Nothing()
    train, test = hold_out(views, rule)
    positions, colors = surface_points([view.camera for view in views])
    return Dataset(train, test, PointCloud(positions, np.clip(colors, 0, 1)), split=str(rule))


def cameras(photos: int = PHOTOS, size: tuple[int, int] = SIZE) -> list[Camera]:
    """Returns cameras around the still life. Every 8th of them, which is held out, lies between others."""
    step = next(k for k in count(7) if gcd(k, photos) == 1)  # visits every azimuth once
    azimuths = np.linspace(*AZIMUTHS, photos)[(np.arange(photos) * step + photos // 2) % photos]
    poses = []
    for i, azimuth in enumerate(np.radians(azimuths)):
        elevation = np.radians(ELEVATIONS[i % len(ELEVATIONS)])
        level = np.array([np.sin(azimuth), -np.cos(azimuth), 0]) * np.cos(elevation)
        position = TARGET + DISTANCE * (level + [0, 0, np.sin(elevation)])
        poses.append(look_at(*(jnp.asarray(v, jnp.float32) for v in (position, TARGET, (0, 0, 1)))))
    return [Camera.simple_pinhole(FOCAL * size[0] / SIZE[0], pose, *size) for pose in poses]


def surface_points(views: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Returns points where rays through random pixels meet a surface, and the colours seen there."""
    rng = np.random.default_rng(0)
    sizes = [(view.width, view.height) for view in views]
    pixels = [rng.uniform(size=(POINTS // len(views), 2)) * size for size in sizes]
    seen = [look(camera, jnp.asarray(p, jnp.float32)) for camera, p in zip(views, pixels, strict=True)]
    colors, positions = (np.concatenate(part) for part in zip(*seen, strict=True))
    met = np.isfinite(positions).all(axis=1)
    return positions[met].astype(np.float64), colors[met]


def _pixels(camera: Camera) -> Pixels:
    return np.asarray(photograph(camera))
