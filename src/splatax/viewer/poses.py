"""Camera poses in viser's convention: position, rotation to the world as wxyz, vertical field of view."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera, as_pinhole
from splatax.trajectories import Keyframe


@dataclass(frozen=True)
class Pose:
    """A browser's camera. Its axes are those of `Camera`: x right, y down, z forward.

    Attributes:
        wxyz: rotation from camera axes to world axes.
        position: optical centre, world units.
        fov: vertical field of view, radians.
        window: width and height of the window, pixels.
    """

    wxyz: Float[np.ndarray, "4"]
    position: Float[np.ndarray, "3"]
    fov: float
    window: tuple[int, int]

    @property
    def key(self) -> Keyframe:
        """The same pose as a keyframe of a trajectory."""
        return Keyframe(self.position, Rotation.from_quat(self.wxyz, scalar_first=True), self.fov)

    def camera(self, size: tuple[int, int]) -> Camera:
        """Returns the camera whose frame of this size fills the window.

        If the size does not have the window's exact proportions, pixels are not exactly square; the
        browser stretches the picture back.
        """
        width, height = size
        half = np.tan(self.fov / 2)
        pose = np.eye(4)
        pose[:3, :3] = self.key.rotation.as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ self.position
        numbers = (
            width / 2 / (half * self.window[0] / self.window[1]),
            height / 2 / half,
            width / 2,
            height / 2,
        )
        fx, fy, cx, cy = (jnp.float32(number) for number in numbers)
        return Camera(fx, fy, cx, cy, jnp.asarray(pose, jnp.float32), width, height)


def pose_of(camera: Camera, window: tuple[int, int]) -> Pose:
    """Returns the pose from which a window shows all that a camera sees, and more in other proportions."""
    camera = as_pinhole(camera)
    matrix = np.asarray(camera.cam_from_world, np.float64)
    rotation = Rotation.from_matrix(matrix[:3, :3].T)
    high = camera.height / 2 / float(camera.fy)
    wide = camera.width / 2 / float(camera.fx)
    half = max(high, wide * window[1] / window[0])
    position = -matrix[:3, :3].T @ matrix[:3, 3]
    return Pose(rotation.as_quat(scalar_first=True), position, 2 * float(np.arctan(half)), window)
