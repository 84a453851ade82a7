"""Writes a reconstruction as a capture that every splatting tool reads: pinhole photos and their model."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatax.io.datasets.photos import LARGEST_SIDE
from splatax.io.datasets.undistortion import undistortion
from splatax.reconstruction.photos import Photo, read, save

if TYPE_CHECKING:
    import pycolmap


def write_capture(
    model: "pycolmap.Reconstruction", photos: dict[str, Photo], out: Path, watch: Callable[[int, int], None]
) -> None:
    """Writes OUT/images and OUT/sparse/0.

    Args:
        model: model of the shrunk photos.
        photos: original photos by their names in the model. They are undistorted at full size.
        out: folder of the capture.
        watch: function that is called with (photos written, all photos).
    """
    import pycolmap

    registered = [model.image(i) for i in sorted(model.reg_image_ids())]
    lenses, pinholes, straighteners = {}, {}, {}
    for image in registered:
        if image.camera_id not in lenses:
            lens = pycolmap.Camera(model.camera(image.camera_id).todict())
            lens.rescale(*photos[image.name].size)
            shrinking = float(-(-max(lens.width, lens.height) // LARGEST_SIDE))  # the loader's factor
            pinhole, straighten = undistortion(lens, shrinking)
            lenses[image.camera_id], pinholes[image.camera_id] = lens, pinhole
            straighteners[image.camera_id] = straighten
    for done, image in enumerate(registered):
        watch(done, len(registered))
        photo, lens = photos[image.name], lenses[image.camera_id]
        save(out / "images" / photo.name, straighteners[image.camera_id](read(photo)))
        shrunk = model.camera(image.camera_id)
        scale = np.array([lens.width / shrunk.width, lens.height / shrunk.height])
        if image.num_points2D():
            slopes = lens.cam_from_img(np.array([point.xy for point in image.points2D]) * scale)
            pixels = pinholes[image.camera_id].img_from_cam(np.column_stack([slopes, np.ones(len(slopes))]))
            for point, pixel in zip(image.points2D, pixels, strict=True):
                point.xy = pixel
        image.name = photo.name
    for camera_id, pinhole in pinholes.items():
        camera = model.camera(camera_id)
        camera.model, camera.params = pinhole.model, pinhole.params.tolist()
        camera.width, camera.height = pinhole.width, pinhole.height
    model.update_point_3d_errors()
    sparse = out / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    model.write_binary(sparse)
    watch(len(registered), len(registered))
