"""Capture of a synthetic scene in COLMAP's layout, with exact cameras and surface points."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pycolmap

from splatax.cameras import Camera
from splatax.demo.dataset import HELD_OUT, surface_points, true_geometry
from splatax.demo.raycast import photograph, visible
from splatax.demo.scene import Scene
from splatax.demo.scenes.still_life import STILL_LIFE
from splatax.io import images
from splatax.io.datasets import TEST_LIST, truth
from splatax.io.files import replacing


def write_capture(folder: Path, scene: Scene = STILL_LIFE) -> None:
    """Writes photos to FOLDER/images, a model to FOLDER/sparse/0, and FOLDER/test.txt.

    Exact depth and normals are written to FOLDER/truth, where `splatax.io.datasets.truth` reads them.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    views = {f"view{i:02}.png": camera for i, camera in enumerate(scene.cameras())}
    for name, camera in views.items():
        images.write(folder / "images" / name, np.asarray(photograph(camera, scene)))
        write_truth(folder / truth.FOLDER, Path(name).with_suffix(".npy"), camera, scene)
    model_of(views, scene).write_binary(folder / "sparse" / "0")
    (folder / TEST_LIST).write_text("".join(f"{name}\n" for name in HELD_OUT.of(list(views))))


def write_truth(folder: Path, name: Path, camera: Camera, scene: Scene) -> None:
    """Writes the exact depth and normals of a view."""
    exact = true_geometry(camera, scene)
    assert exact.normals is not None
    # Half precision turns a normal by 0.02 degrees.
    for kind, values in (("depth", exact.depth), ("normals", exact.normals.astype(np.float16))):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        with replacing(folder / kind / name) as file:
            np.lib.format.write_array(file, values, allow_pickle=False)


def model_of(views: dict[str, Camera], scene: Scene) -> pycolmap.Reconstruction:
    """Returns a COLMAP model of points on surfaces, observed by all cameras that see them."""
    positions, colors = surface_points(list(views.values()), scene)
    model = pycolmap.Reconstruction()
    first = next(iter(views.values()))
    intrinsics = [float(value) for value in (first.fx, first.fy, first.cx, first.cy)]
    lens = pycolmap.Camera(
        model="PINHOLE", width=first.width, height=first.height, params=intrinsics, camera_id=1
    )
    model.add_camera_with_trivial_rig(lens)
    ids = [
        model.add_point3D(position, pycolmap.Track(), np.round(255 * color).astype(np.uint8))
        for position, color in zip(positions, np.clip(colors, 0, 1), strict=True)
    ]
    for image_id, (name, camera) in enumerate(views.items(), start=1):
        pose = pycolmap.Rigid3d(np.asarray(camera.cam_from_world, np.float64)[:3])
        pixels, visible = observations(camera, positions, scene)
        image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels[visible]])
        model.add_image_with_trivial_frame(image, pose)
        for index, point in enumerate(np.flatnonzero(visible)):
            model.add_observation(ids[point], pycolmap.TrackElement(image_id, index))
    return model


def observations(camera: Camera, positions: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels of points, and a mask of those inside the image that nothing hides."""
    points = jnp.asarray(positions, jnp.float32)
    local = jax.vmap(camera.to_camera)(points)
    pixels = np.asarray(jax.vmap(camera.to_pixel)(local), np.float64)
    in_front = np.asarray(local[:, 2]) > 0
    inside = in_front & np.all((pixels > 0) & (pixels < (camera.width, camera.height)), axis=1)
    return pixels, inside & np.asarray(visible(camera, points, scene))
