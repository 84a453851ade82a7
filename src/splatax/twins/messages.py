"""Fields of ROS 2 messages, as dictionaries, from measurements of sensors, cameras and poses.

Nothing here imports ROS: a node gives the fields to its messages, as docs/ros2_twin_node.py does. Bytes are
little endian. Camera frames are ROS's optical frames (REP 103: x right, y down, z forward), which are the
camera axes of splatax.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera, to_opencv
from splatax.cameras.lenses import Fisheye, OpenCV, Pinhole
from splatax.errors import InputError
from splatax.metrics import to_8bit
from splatax.transforms import Similarity

FLOAT32 = 7  # of sensor_msgs/PointField
ENCODINGS = {"<f4": "32FC1", "<u2": "16UC1", "<i4": "32SC1"}  # of images of one channel


def image_fields(image: Any) -> dict[str, Any]:
    """Returns the fields of a sensor_msgs/Image, without its header.

    Args:
        image: colours [h w 3] in [0, 1], which become rgb8; depths [h w] in metres, which become 32FC1 (NaN
            where nothing is measured, by REP 118); millimetres of 16 bits, which become 16UC1; or labels [h
            w] of 32 bits, which become 32SC1.

    Raises:
        InputError: if it is none of these.
    """
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 3 and array.dtype.kind == "f":
        rows, encoding = to_8bit(array), "rgb8"
    else:
        rows = array.astype(array.dtype.newbyteorder("<"))
        encoding = ENCODINGS.get(rows.dtype.str, "")
        if array.ndim != 2 or not encoding:
            raise InputError(
                f"an image of {array.dtype} and shape {array.shape}. Give colours [h w 3], depths [h w], "
                "millimetres of 16 bits, or labels of 32 bits."
            )
    height, width = rows.shape[:2]
    return {
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows[0].nbytes if height else 0,
        "data": np.ascontiguousarray(rows).tobytes(),
    }


def camera_info_fields(camera: Camera) -> dict[str, Any]:
    """Returns the fields of a sensor_msgs/CameraInfo, without its header.

    ROS counts pixels from the centre of the first one, so the principal point is half a pixel less.

    Raises:
        InputError: if ROS has no distortion model for the lens.
    """
    match camera.lens:
        case Pinhole():
            model, coefficients = "plumb_bob", np.zeros(5)
        case OpenCV(radials, tangentials, prism) if not np.any(prism):
            k1, k2, k3, *rest = np.asarray(radials, np.float64)
            model, coefficients = "rational_polynomial", np.array([k1, k2, *tangentials, k3, *rest])
        case Fisheye(radials):
            model, coefficients = "equidistant", np.asarray(radials, np.float64)
        case lens:
            raise InputError(
                f"ROS has no distortion model for the lens {type(lens).__name__}. Use a pinhole, OpenCV "
                "without thin prism, or fisheye lens."
            )
    matrix = np.array(to_opencv(camera)[0], np.float64)
    matrix[:2, 2] -= 0.5
    return {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": model,
        "d": coefficients.tolist(),
        "k": matrix.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
    }


def cloud_fields(points: Any) -> dict[str, Any]:
    """Returns the fields of a sensor_msgs/PointCloud2 without its header; `fields` are dictionaries too.

    Args:
        points: [h w 3] of an organized cloud, or [n 3], NaN where nothing is measured.

    Raises:
        InputError: if the array has another shape.
    """
    rows = np.asarray(points).astype("<f4")
    if rows.ndim not in (2, 3) or rows.shape[-1] != 3:
        raise InputError(f"points of shape {rows.shape}. Give [h w 3] or [n 3].")
    height, width = rows.shape[:2] if rows.ndim == 3 else (1, len(rows))
    fields = [
        {"name": axis, "offset": 4 * i, "datatype": FLOAT32, "count": 1} for i, axis in enumerate("xyz")
    ]
    return {
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * width,
        "data": np.ascontiguousarray(rows).tobytes(),
        "is_dense": bool(np.isfinite(rows).all()),
    }


def pose_from(translation: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "4"]) -> Similarity:
    """Returns the pose of a geometry_msgs/Transform.

    Args:
        translation: x, y, z, metres.
        rotation: quaternion in ROS's order (x, y, z, w), of any length above 0.

    Raises:
        InputError: if the quaternion is zero or a number is not finite.
    """
    numbers = np.concatenate([translation, rotation])
    if not np.isfinite(numbers).all() or not np.any(rotation):
        raise InputError(f"a pose of {translation} and {rotation}. Give finite numbers and a rotation.")
    return Similarity(Rotation.from_quat(rotation).as_matrix(), np.array(translation, np.float64))


def pose_fields(pose: Similarity) -> dict[str, dict[str, float]]:
    """Returns the fields of a geometry_msgs/Transform: `translation` and `rotation`, by x, y, z and w.

    Raises:
        InputError: if the scale is not 1, which ROS has no field for.
    """
    if abs(float(pose.scale) - 1) > 1e-6:
        raise InputError(f"a pose with the scale {float(pose.scale):g}. Transforms of ROS are rigid.")
    turn = Rotation.from_matrix(np.asarray(pose.rotation, np.float64)).as_quat()
    place = np.asarray(pose.translation, np.float64)
    return {
        "translation": dict(zip("xyz", place.tolist(), strict=True)),
        "rotation": dict(zip("xyzw", turn.tolist(), strict=True)),
    }
