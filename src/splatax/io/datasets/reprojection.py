"""Measures how well cameras and points agree, using splatax's own projection."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera
from splatax.cameras.geometry import seen_at
from splatax.cameras.lenses import Pinhole

if TYPE_CHECKING:
    import pycolmap

MAX_VIEWS = 40  # evenly spaced over the capture
SAMPLES = 512  # observations per view; one shape for all views compiles once


def reprojection_errors(
    model: "pycolmap.Reconstruction", registered: "dict[str, pycolmap.Image]", cameras: dict[str, Camera]
) -> dict[str, Float[np.ndarray, " _"]]:
    """Returns the reprojection errors of a sample of observations, in pixels of the loaded views.

    Args:
        model: COLMAP model.
        registered: registered images of the model by name, sorted.
        cameras: camera of each image, by name.

    Returns:
        Errors by name, for a sample of the images that have observations.
    """
    errors = {}
    for name in list(registered)[:: -(-len(registered) // MAX_VIEWS)]:
        image = registered[name]
        observed = [p for p in image.get_observation_points2D() if model.exists_point3D(p.point3D_id)]
        if not observed:
            continue
        sample = observed[:: -(-len(observed) // SAMPLES)]
        count, sample = len(sample), (sample * SAMPLES)[:SAMPLES]  # repeated to fill the fixed shape
        points = np.array([model.point3D(p.point3D_id).xyz for p in sample], np.float32)
        seen = observed_at(model.camera(image.camera_id), np.array([p.xy for p in sample]), cameras[name])
        drawn, _ = seen_at(cameras[name], points)
        apart = np.linalg.norm(drawn - seen, axis=1)[:count]
        errors[name] = np.where(np.isfinite(apart), apart, np.inf)  # a point that the camera does not see
    return errors


def observed_at(
    calibrated: "pycolmap.Camera", pixels: Float[np.ndarray, "n 2"], camera: Camera
) -> Float[np.ndarray, "n 2"]:
    """Returns observations of a photo in the pixels of its view, which may be undistorted or smaller."""
    if isinstance(camera.lens, Pinhole):  # COLMAP's lens model maps observations to slopes
        slopes = np.asarray(calibrated.cam_from_img(pixels))
        return slopes * np.asarray(camera.focal) + np.asarray(camera.center)
    return pixels * [camera.width / calibrated.width, camera.height / calibrated.height]
