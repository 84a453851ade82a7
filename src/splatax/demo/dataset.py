"""Data set of a synthetic scene in memory: cameras, photos and surface points."""

from functools import cache, partial

import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera
from splatax.dataset import Dataset, Pixels, PointCloud, TrueGeometry, View, hold_out
from splatax.demo.raycast import look, photograph, truth, visible
from splatax.demo.scene import SIZE, Scene
from splatax.demo.scenes import DEFAULT, scene_named
from splatax.splits import Every, Nothing

POINTS = 3000
HELD_OUT = Every(first=1)  # these lie between others


def demo_dataset(
    photos: int | None = None, width: int = SIZE[0], height: int = SIZE[1], scene: str = DEFAULT
) -> Dataset:
    """Returns a small capture of a procedural scene, without reading or writing files.

    The cameras and the points are exact. Every 8th photo is held out, from the first. A photo is ray traced
    when its `pixels` is called for the first time.

    Args:
        photos: number of photos, at least 1. None takes as many as suits the scene, 24 to 40.
        width: width of a photo, pixels. The horizontal field of view does not depend on it.
        height: height of a photo, pixels.
        scene: name of the scene: "still-life", "room", "object", "outdoor", "thin" or "glossy".

    Raises:
        ValueError: if there is no photo, a photo has no pixel, or no scene has that name.
    """
    drawn = scene_named(scene)
    photos = drawn.photos if photos is None else photos
    if min(photos, width, height) < 1:
        raise ValueError(f"a capture needs photos with pixels, not {photos} of {width} x {height} pixels")
    cameras = drawn.cameras(photos, (width, height))
    positions, colors = surface_points(list(cameras), drawn)
    views = [
        View(
            f"view{i:02}.png",
            camera,
            cache(partial(_pixels, camera, drawn)),
            landmarks=partial(_landmarks, camera, positions, drawn),
            truth=partial(true_geometry, camera, drawn),
        )
        for i, camera in enumerate(cameras)
    ]
    rule = HELD_OUT if photos > 1 else Nothing()
    train, test = hold_out(views, rule)
    cloud = PointCloud(positions, np.clip(colors, 0, 1))
    return Dataset(train, test, cloud, background=drawn.background, split=str(rule))


def surface_points(views: list[Camera], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Returns points where rays through random pixels meet a surface, and the colours seen there."""
    rng = np.random.default_rng(0)
    sizes = [(view.width, view.height) for view in views]
    pixels = [rng.uniform(size=(POINTS // len(views), 2)) * size for size in sizes]
    seen = [look(camera, jnp.asarray(p, jnp.float32), scene) for camera, p in zip(views, pixels, strict=True)]
    colors, positions = (
        np.concatenate(part) for part in zip(*((s.color, s.point) for s in seen), strict=True)
    )
    met = np.isfinite(positions).all(axis=1)
    return positions[met].astype(np.float64), colors[met]


def _landmarks(camera: Camera, positions: np.ndarray, scene: Scene) -> np.ndarray:
    """Returns the points that nothing hides from a camera; some of them lie beside the image."""
    points = positions.astype(np.float32)
    return points[np.asarray(visible(camera, jnp.asarray(points), scene))]


def true_geometry(camera: Camera, scene: Scene) -> TrueGeometry:
    """Returns exact depth and normals at the centre of each pixel; 0 without a surface."""
    exact = truth(camera, scene)
    depth = np.asarray(exact.depth)
    return TrueGeometry(np.where(np.isfinite(depth), depth, 0), np.asarray(exact.normals))


def _pixels(camera: Camera, scene: Scene) -> Pixels:
    return np.asarray(photograph(camera, scene))
