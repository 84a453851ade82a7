"""Preparation of a scene for the web viewer: levelled, of standard size, and with a viewpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera, as_pinhole, look_at, rig
from splatax.cameras.geometry import seen_at
from splatax.editing.placing import UP, level
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.transforms import Similarity

SIZE = 4.0  # radius of the cameras (or, without any, of the Gaussians) around their middle, viewer units
LEAST_TURN = 0.03  # least eigenvalue for which the optical axes define a common point
SAMPLE = 20_000  # Gaussians from which the depth seen by a camera is measured
FIELD_OF_VIEW = 50.0  # degrees, for scenes without cameras
# From axes right, down, forward (COLMAP) to right, up, back (three.js), of cameras and of worlds.
HALF_TURN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Stage:
    """The placement of a scene and its cameras in the viewer.

    Attributes:
        place: transform from the world to the viewer's frame, in which y still points down.
        poses: poses of the cameras in that frame, with the fields of web/src/pose.js.
        start: initial pose, and its index among the cameras (-1 if it is none of them).
    """

    place: Similarity
    poses: list[dict]
    start: dict


def stage(gaussians: Gaussians, cameras: Mapping[str, Camera]) -> Stage:
    """Places a scene according to its cameras or, without cameras, according to the Gaussians.

    Args:
        gaussians: the scene, at least one Gaussian.
        cameras: cameras of the capture by name; may be empty.
    """
    means = np.asarray(gaussians.means, np.float64)
    if not cameras:
        middle, radius = spread_of(means)
        place = _place(np.eye(3), middle, SIZE / radius)
        return Stage(place, [], pose_of(_outside(), 2.4 * SIZE) | {"camera": -1})
    poses = list(cameras.values())
    eyes = rig.positions_of(poses)
    middle = eyes.mean(axis=0)
    depths = _focal_distances(means, poses)
    spread = float(np.linalg.norm(eyes - middle, axis=1).max())
    extent = max(spread, 0.2 * float(np.median(depths)))  # cameras in one place: from the depths seen
    place = _place(_levelling(poses), middle, SIZE / extent)
    there = [
        pose_of(place.transform_camera(camera), float(place.scale) * depth)
        for camera, depth in zip(poses, depths, strict=True)
    ]
    central = int(np.argmin(np.linalg.norm(eyes - np.median(eyes, axis=0), axis=1)))
    return Stage(place, there, there[central] | {"camera": central})


def spread_of(means: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Returns the middle of Gaussians, and the radius around it that holds 95 % of them.

    Those that are not finite, which a page leaves out, do not count.
    """
    finite = means[np.isfinite(means).all(axis=1)]
    middle = np.median(finite, axis=0)
    return middle, float(np.quantile(np.linalg.norm(finite - middle, axis=1), 0.95)) or 1.0


def pose_of(camera: Camera, focus: float) -> dict:
    """Converts a camera to a pose of the viewer, with y up, and `focus` as the distance of its pivot."""
    camera = as_pinhole(camera)
    rotation = HALF_TURN @ np.asarray(camera.rotation, np.float64).T @ HALF_TURN
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    width, height = camera.width, camera.height
    return {
        "position": _rounded(HALF_TURN @ np.asarray(camera.position, np.float64)),
        "quaternion": _rounded(Rotation.from_matrix(rotation).as_quat()),
        "lens": {
            "aspect": width / height,
            "fx": 2 * fx / width,
            "fy": 2 * fy / height,
            "sx": 1 - 2 * cx / width,
            "sy": 2 * cy / height - 1,
        },
        "focus": round(float(focus), 4),
    }


def pose_at(place: Similarity, means: Float[np.ndarray, "n 3"], camera: Camera) -> dict:
    """Converts a camera of the world to a pose of the viewer, which turns about what the camera sees."""
    sample = means[:: max(len(means) // SAMPLE, 1)]
    return pose_of(place.transform_camera(camera), float(place.scale) * _median_depth(sample, camera))


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 7) for value in values]


def _place(rotation: Float[np.ndarray, "3 3"], middle: Float[np.ndarray, "3"], scale: float) -> Similarity:
    return Similarity(rotation, -scale * rotation @ middle, scale)


def _levelling(cameras: Sequence[Camera]) -> Float[np.ndarray, "3 3"]:
    """Returns the levelling rotation, or the identity if the cameras were held in all directions."""
    try:
        return np.asarray(level(cameras).rotation)
    except InputError:
        return np.eye(3)


def _focal_distances(means: Float[np.ndarray, "n 3"], cameras: Sequence[Camera]) -> Float[np.ndarray, " c"]:
    """Returns the distance ahead of each camera of the point that all cameras look at.

    If there is no such point, it is the median depth of the Gaussians that the camera sees.
    """
    target = rig.focus_of(cameras, LEAST_TURN)
    if target is not None:
        distances = np.sum((target - rig.positions_of(cameras)) * rig.axes_of(cameras), axis=1)
        if distances.min() > 0.1 * np.median(distances):
            return distances
    sample = means[:: max(len(means) // SAMPLE, 1)]
    return np.array([_median_depth(sample, camera) for camera in cameras])


def _median_depth(means: Float[np.ndarray, "n 3"], camera: Camera) -> float:
    """Returns the median depth of the Gaussians inside a camera's image; 1 if there are none."""
    (u, v), depths = (found.T for found in seen_at(camera, means))
    seen = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    return float(np.median(depths[seen])) if np.any(seen) else 1.0


def _outside() -> Camera:
    """Returns a camera that sees a whole scene of standard size around the origin, from slightly above."""
    eye = jnp.array([0.0, -0.35, -1.0]) * SIZE * 2.4 / np.hypot(0.35, 1)
    pose = look_at(eye, jnp.zeros(3), jnp.asarray(UP, jnp.float32))
    width, height = 1600, 1000
    return Camera.simple_pinhole(height / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2)), pose, width, height)
