"""Measures how well cameras and points agree, using splatax's own projection."""

from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras import Camera

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
        cameras: pinhole camera of each image, by name.

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
        # COLMAP's lens model maps observations to slopes; the pinhole maps slopes to pixels of the view.
        camera = cameras[name]
        slopes = model.camera(image.camera_id).cam_from_img(np.array([p.xy for p in sample]))
        seen = np.asarray(slopes) * [float(camera.fx), float(camera.fy)] + [
            float(camera.cx),
            float(camera.cy),
        ]
        drawn = _to_pixels(replace(camera, width=1, height=1), points)
        errors[name] = np.linalg.norm(np.asarray(drawn) - seen, axis=1)[:count]
    return errors


@jax.jit
def _to_pixels(camera: Camera, points: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
    return jax.vmap(lambda point: camera.to_pixel(camera.to_camera(point)))(points)
