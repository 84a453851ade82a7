"""Cameras from and to the conventions of other programs.

    OpenCV, COLMAP, gsplat         world -> camera, x right, y down, z forward      (as splatax)
    OpenGL, Blender, nerfstudio    camera -> world, x right, y up, z backward

Pixel coordinates have the image's corner at (0, 0) in COLMAP, OpenGL and gsplat, as here. In OpenCV's own
functions the centre of the first pixel is (0, 0): add half a pixel to its principal points.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras.camera import Camera
from splatax.cameras.lenses import (
    Equirectangular,
    FieldOfView,
    Fisheye,
    Lens,
    OpenCV,
    Pinhole,
    RadTanThinPrismFisheye,
    ThinPrismFisheye,
    opencv,
)

PANORAMA = "EQUIRECTANGULAR"  # of COLMAP
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: y down, z forward <-> y up, z backward


def from_opencv(
    intrinsics: Float[Array, "3 3"],
    cam_from_world: Float[Array, "4 4"],
    width: int,
    height: int,
    lens: Lens = Pinhole(),
) -> Camera:
    """Returns a camera from a calibration matrix and a view matrix, as gsplat's `Ks` and `viewmats`.

    Args:
        intrinsics: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels.
        cam_from_world: rigid, with y down and z forward.
        width, height: image size, pixels.
        lens: its distortion.
    """
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    return Camera(fx, fy, cx, cy, cam_from_world, width, height, lens)


def from_opengl(
    intrinsics: Float[Array, "3 3"],
    world_from_cam: Float[Array, "4 4"],
    width: int,
    height: int,
    lens: Lens = Pinhole(),
) -> Camera:
    """Returns a camera from a camera-to-world matrix with y up and z backward, as in nerfstudio and Blender.

    The arguments are those of `from_opencv`, except for the matrix.
    """
    turned = world_from_cam @ jnp.asarray(TO_OPENGL, world_from_cam.dtype)
    return from_opencv(intrinsics, jnp.linalg.inv(turned), width, height, lens)


def to_opencv(camera: Camera) -> tuple[Float[Array, "3 3"], Float[Array, "4 4"]]:
    """Returns the calibration matrix and the world-to-camera matrix of a camera."""
    zero, one = jnp.zeros_like(camera.fx), jnp.ones_like(camera.fx)
    intrinsics = [[camera.fx, zero, camera.cx], [zero, camera.fy, camera.cy], [zero, zero, one]]
    return jnp.array(intrinsics), camera.cam_from_world


def to_opengl(camera: Camera) -> tuple[Float[Array, "3 3"], Float[Array, "4 4"]]:
    """Returns the calibration matrix, and the camera-to-world matrix with y up and z backward."""
    intrinsics, cam_from_world = to_opencv(camera)
    axes = jnp.asarray(TO_OPENGL, cam_from_world.dtype)
    return intrinsics, jnp.linalg.inv(cam_from_world) @ axes


def panorama(cam_from_world: Float[Array, "4 4"], width: int, height: int) -> Camera:
    """Returns a camera that shows the whole sphere, as a 360-degree camera does.

    The middle of the image looks along the pose's z axis.
    """
    numbers = (width / (2 * math.pi), height / math.pi, width / 2, height / 2)
    fx, fy, cx, cy = (jnp.asarray(number, cam_from_world.dtype) for number in numbers)
    return Camera(fx, fy, cx, cy, cam_from_world, width, height, Equirectangular())


def as_pinhole(camera: Camera) -> Camera:
    """Returns a pinhole camera at a camera's place, for viewers that know no other.

    A perspective keeps its focal lengths. Other lenses keep theirs too, unless the image would be more than
    90 degrees wide or high.
    """
    if isinstance(camera.lens, Pinhole) and camera.motion is None:
        return camera
    fx, fy = camera.fx, camera.fy
    if not isinstance(camera.lens, OpenCV | FieldOfView | Pinhole):
        least = jnp.asarray(max(camera.width, camera.height) / 2, fx.dtype)
        fx, fy = jnp.maximum(fx, least), jnp.maximum(fy, least)
    return replace(camera, fx=fx, fy=fy, lens=Pinhole(), motion=None)


class _Model(NamedTuple):
    """COLMAP's name of a lens: how many focal lengths it has, and the lens of its other parameters."""

    focals: int
    lens: Callable[[Sequence[float]], Lens]


def _floats(*arrays: Sequence[float]) -> list[Array]:
    return [jnp.asarray(np.asarray(array, np.float32)) for array in arrays]


def _fisheye(k: Sequence[float]) -> Lens:
    return Fisheye(*_floats([*k, 0.0, 0.0, 0.0, 0.0][:4]))


COLMAP_MODELS: dict[str, _Model] = {
    "SIMPLE_PINHOLE": _Model(1, lambda k: Pinhole()),
    "PINHOLE": _Model(2, lambda k: Pinhole()),
    "SIMPLE_RADIAL": _Model(1, lambda k: opencv(*k)),
    "RADIAL": _Model(1, lambda k: opencv(*k)),
    "OPENCV": _Model(2, lambda k: opencv(*k)),
    "FULL_OPENCV": _Model(2, lambda k: opencv(*k)),
    "FOV": _Model(2, lambda k: FieldOfView(jnp.float32(k[0]))),
    "SIMPLE_FISHEYE": _Model(1, _fisheye),
    "FISHEYE": _Model(2, _fisheye),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, _fisheye),
    "RADIAL_FISHEYE": _Model(1, _fisheye),
    "OPENCV_FISHEYE": _Model(2, _fisheye),
    "THIN_PRISM_FISHEYE": _Model(2, lambda k: ThinPrismFisheye(*_floats([*k[:2], *k[4:6]], k[2:4], k[6:8]))),
    "RAD_TAN_THIN_PRISM_FISHEYE": _Model(
        2, lambda k: RadTanThinPrismFisheye(*_floats(k[:6], k[6:8], k[8:12]))
    ),
}


def from_colmap(
    model: str, parameters: Sequence[float], width: int, height: int, cam_from_world: Float[Array, "4 4"]
) -> Camera:
    """Returns a camera from COLMAP's.

    Args:
        model: COLMAP's name of the lens, such as "OPENCV".
        parameters: in COLMAP's order.
        width, height: image size, pixels.
        cam_from_world: pose.

    Raises:
        ValueError: if splatax has no such lens.
    """
    if model == PANORAMA:
        return panorama(cam_from_world, width, height)
    if model not in COLMAP_MODELS:
        known = ", ".join([*COLMAP_MODELS, PANORAMA])
        raise ValueError(f"splatax has no lens for COLMAP's camera model {model}: undistort, or use {known}")
    focals, lens = COLMAP_MODELS[model]
    affine = (parameters[0], parameters[focals - 1], *parameters[focals : focals + 2])
    fx, fy, cx, cy = (jnp.asarray(number, cam_from_world.dtype) for number in affine)
    others = parameters[focals + 2 :]
    known = jax.tree.map(lambda leaf: leaf.astype(cam_from_world.dtype), lens(others))
    return Camera(fx, fy, cx, cy, cam_from_world, width, height, known)


def to_colmap(camera: Camera) -> tuple[str, list[float]]:
    """Returns COLMAP's model and parameters of a camera.

    Raises:
        ValueError: if COLMAP has no such lens, or it moves during the exposure.
    """
    lens = camera.lens
    match lens:
        case _ if camera.motion is not None:
            raise ValueError("COLMAP's cameras do not move during the exposure")
        case Pinhole():
            model, others = "PINHOLE", []
        case OpenCV() if not np.any(np.asarray(lens.prism)):
            k = lens.radials
            model, others = "FULL_OPENCV", [k[:2], lens.tangentials, k[2:]]
        case FieldOfView():
            model, others = "FOV", [lens.angle]
        case Fisheye():
            model, others = "OPENCV_FISHEYE", [lens.radials]
        case ThinPrismFisheye():
            k = lens.radials
            model, others = "THIN_PRISM_FISHEYE", [k[:2], lens.tangentials, k[2:], lens.prism]
        case RadTanThinPrismFisheye():
            model, others = "RAD_TAN_THIN_PRISM_FISHEYE", [lens.radials, lens.tangentials, lens.prism]
        case Equirectangular():
            return PANORAMA, [float(camera.width), float(camera.height)]
        case _:
            raise ValueError(f"COLMAP has no camera model for {lens}")
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *others]
    return model, [float(number) for part in numbers for number in np.atleast_1d(np.asarray(part))]
