"""Captures on disk for tests, written by pycolmap itself."""

from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

SIZE = (64, 48)
POINTS = np.random.default_rng(0).uniform(-1, 1, (30, 3))


def pinhole(camera_id=1, size=SIZE):
    return pycolmap.Camera(
        model="PINHOLE", width=size[0], height=size[1], params=[60, 61, 30, 25], camera_id=camera_id
    )


def radial(camera_id=1):
    return pycolmap.Camera(
        model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[60, 32, 24, 0.05], camera_id=camera_id
    )


def model_of(names, camera) -> pycolmap.Reconstruction:
    """Cameras in a row that look along z at points around the origin; observations are exact."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    ids = [
        model.add_point3D(p + [0, 0, 5], pycolmap.Track(), np.array([10, 20, 30], np.uint8)) for p in POINTS
    ]
    for i, name in enumerate(names, start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0.02 * i, 0, 1]), np.array([0.1 * i, 0, 0]))
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=i)
        image.points2D = [pycolmap.Point2D(camera.img_from_cam(pose * model.point3D(j).xyz)) for j in ids]
        model.add_image_with_trivial_frame(image, pose)
        for k, j in enumerate(ids):
            model.add_observation(j, pycolmap.TrackElement(i, k))
    return model


def write_capture(folder: Path, count=9, camera=None, text=False, size=SIZE, mode="RGB") -> Path:
    names = [f"photo{i:02}.png" for i in range(count)]
    model = model_of(names, camera or pinhole())
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(sparse)
    (folder / "images").mkdir()
    rng = np.random.default_rng(1)
    for name in names:
        pixels = rng.integers(0, 255, (size[1], size[0], len(mode)), np.uint8)
        Image.fromarray(pixels, mode).save(folder / "images" / name)
    return folder
