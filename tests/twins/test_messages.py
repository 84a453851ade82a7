"""Fields of ROS 2 messages, and the example node with test doubles for ROS."""

import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import sensors
from splatax.cameras.lenses import Equirectangular, Fisheye, opencv
from splatax.transforms import Similarity
from splatax.twins.messages import camera_info_fields, cloud_fields, image_fields, pose_fields, pose_from

NODE = Path(__file__).parents[2] / "docs" / "ros2_twin_node.py"


@pytest.mark.parametrize(
    ("image", "encoding", "dtype", "bytes_of_row"),
    [
        (np.array([[[0.0, 0.5, 1.0], [1.0, 0.2, 0.0]]]), "rgb8", "u1", 6),
        (np.array([[1.5, np.nan]], np.float32), "32FC1", "<f4", 8),
        (np.array([[1500, 0]], np.uint16), "16UC1", "<u2", 4),
        (np.array([[-1, 70_000]], np.int32), "32SC1", "<i4", 8),
    ],
)
def test_an_image_keeps_its_numbers_in_the_encoding_of_its_kind(image, encoding, dtype, bytes_of_row):
    fields = image_fields(image)
    assert (fields["height"], fields["width"], fields["encoding"]) == (1, 2, encoding)
    assert (fields["step"], fields["is_bigendian"]) == (bytes_of_row, 0)
    expected = np.round(image * 255) if encoding == "rgb8" else image
    assert_array_equal(np.frombuffer(fields["data"], dtype), expected.ravel())
    assert image_fields(jnp.asarray(image))["data"] == fields["data"]


def test_arrays_that_are_no_images_are_refused():
    for wrong in (np.zeros((2, 2, 4)), np.zeros((2, 2)), np.zeros(3, np.float32)):
        with pytest.raises(sx.InputError, match="an image of"):
            image_fields(wrong)


def test_a_calibration_projects_a_point_to_the_pixel_of_the_camera_less_half_a_pixel():
    camera = camera_at((0.3, 0.2, -3.0))
    fields = camera_info_fields(camera)
    pose, point = np.asarray(camera.cam_from_world, np.float64), np.array([0.2, -0.1, 0.4, 1.0])
    x, y, z = np.array(fields["p"]).reshape(3, 4) @ pose @ point
    expected = camera.to_pixel(jnp.asarray((pose @ point)[:3], jnp.float32))
    assert_allclose([x / z + 0.5, y / z + 0.5], expected, atol=1e-4)
    assert_array_equal(np.array(fields["k"]).reshape(3, 3), np.array(fields["p"]).reshape(3, 4)[:, :3])
    assert fields["d"] == [0.0] * 5


def test_a_lens_of_opencv_and_its_calibration_project_alike():
    """ROS's rational_polynomial is OpenCV's model, with x to the right, y down and z forward (REP 103)."""
    bent = replace(camera_at((0.0, 0.0, 0.0), target=(0, 0, 1)), lens=opencv(0.1, 0.02, 0.003, 0.004, 0.05))
    fields = camera_info_fields(bent)
    k1, k2, p1, p2, k3, *_ = fields["d"]
    point = np.asarray(bent.to_camera(jnp.array([0.2, -0.1, 1.5])), np.float64)
    x, y = point[:2] / point[2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    pixel = (np.array(fields["k"]).reshape(3, 3) @ [u, v, 1])[:2]
    assert_allclose(pixel + 0.5, bent.to_pixel(jnp.asarray(point, jnp.float32)), atol=1e-3)


def test_the_numbers_of_a_cloud_lie_where_its_fields_say():
    fields = cloud_fields(np.arange(24, dtype=np.float32).reshape(2, 4, 3))
    layout = [
        (field["name"], field["offset"], field["datatype"], field["count"]) for field in fields["fields"]
    ]
    assert layout == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]  # 7: FLOAT32
    assert (fields["point_step"], fields["is_bigendian"]) == (12, False)
    assert len(fields["data"]) == fields["row_step"] * fields["height"]


def test_distortions_are_in_the_order_of_ros():
    camera = camera_at()
    bent = replace(camera, lens=opencv(0.1, 0.02, 0.003, 0.004, 0.05))  # k1 k2 p1 p2 k3
    fields = camera_info_fields(bent)
    assert fields["distortion_model"] == "rational_polynomial"
    assert_allclose(fields["d"], [0.1, 0.02, 0.003, 0.004, 0.05, 0, 0, 0], rtol=1e-6)
    fisheye = replace(camera, lens=Fisheye(jnp.array([0.1, 0.2, 0.3, 0.4])))
    assert camera_info_fields(fisheye)["distortion_model"] == "equidistant"
    assert_allclose(camera_info_fields(fisheye)["d"], [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    with pytest.raises(sx.InputError, match="no distortion model for the lens Equirectangular"):
        camera_info_fields(replace(camera, lens=Equirectangular()))


def test_a_cloud_keeps_its_points_and_its_order():
    points = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    fields = cloud_fields(points)
    assert (fields["height"], fields["width"], fields["row_step"], fields["is_dense"]) == (2, 4, 48, True)
    kinds = [(field["name"], "<f4") for field in fields["fields"]]
    rows = np.frombuffer(fields["data"], kinds)
    assert_array_equal(np.stack([rows[axis] for axis in "xyz"], 1), points.reshape(-1, 3))
    points[0, 0] = np.nan
    assert not cloud_fields(points)["is_dense"]
    assert cloud_fields(points.reshape(-1, 3))["width"] == 8
    with pytest.raises(sx.InputError, match="points of shape"):
        cloud_fields(np.zeros((2, 2)))


def test_a_pose_survives_the_way_to_ros_and_back():
    pose = Similarity.of(degrees=(20.0, -30.0, 100.0), move=(0.1, 0.2, -0.3))
    fields = pose_fields(pose)
    again = pose_from(
        np.array([fields["translation"][axis] for axis in "xyz"]),
        np.array([fields["rotation"][axis] for axis in "xyzw"]),
    )
    assert_allclose(again.rotation, pose.rotation, atol=1e-12)
    assert_allclose(again.translation, pose.translation)
    with pytest.raises(sx.InputError, match="scale 2"):
        pose_fields(Similarity.of(scale=2.0))
    with pytest.raises(sx.InputError, match="a rotation"):
        pose_from(np.zeros(3), np.zeros(4))


class Message:
    """A message of ROS, whose fields can be set."""

    def __init__(self):
        self.header = SimpleNamespace()


class Node:
    """Keeps what a node publishes, and gives it the parameters of the test."""

    def __init__(self, name):
        self.sent = {}

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=type(self).given.get(name, value))

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.sent.update({topic: message}))

    def create_timer(self, period, callback):
        self.period = period

    def get_logger(self):
        return SimpleNamespace(warning=lambda text, **_: setattr(self, "warned", text))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))


TURN = (0.0, 0.0, 0.0, 1.0)
POSES = {"cup": ((0.2, 0.0, 0.0), TURN), "camera_optical_frame": ((0.0, 0.0, -4.0), TURN)}


class Buffer:
    """Gives the poses of the test as tf does."""

    def lookup_transform(self, target, source, time):
        if POSES[source] is None:
            raise KeyError(source)
        place, turn = POSES[source]
        found = SimpleNamespace(
            translation=SimpleNamespace(**dict(zip("xyz", place, strict=True))),
            rotation=SimpleNamespace(**dict(zip("xyzw", turn, strict=True))),
        )
        return SimpleNamespace(transform=found)


def test_the_example_node_publishes_what_the_sensors_measure(monkeypatch, tmp_path):
    doubles = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.time": {"Time": lambda: None},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": Message, "CameraInfo": Message},
        "tf2_ros": {
            "Buffer": Buffer,
            "TransformException": KeyError,
            "TransformListener": lambda *_: None,
        },
    }
    for name, members in doubles.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    cloud = random_gaussians(n=30, degree=0)
    scene = sx.Scene({"world": sx.Part(cloud), "cup": sx.Part(cloud)})
    sx.save_scene(tmp_path / "lab.glb", scene)
    settings = {"scene": str(tmp_path / "lab.glb"), "width": 32, "height": 24, "focal": 30.0}
    monkeypatch.setattr(Node, "given", settings, raising=False)
    node = runpy.run_path(str(NODE))["TwinNode"]()
    node.publish()
    camera = sx.Camera.simple_pinhole(30.0, jnp.eye(4).at[2, 3].set(4), 32, 24)
    placed = scene.posed({"cup": Similarity.of(move=(0.2, 0.0, 0.0))})
    seen = sensors.observe(placed, camera, {"depth": sensors.Depth(invalid=np.nan), "rgb": sensors.Color()})
    depth, color = node.sent["depth/image_raw"], node.sent["color/image_raw"]
    sent = np.frombuffer(depth.data, "<f4").reshape(24, 32)
    assert_allclose(sent, seen["depth"], atol=1e-4)
    assert np.isfinite(sent).any()
    sent = np.frombuffer(color.data, "u1").reshape(24, 32, 3)
    assert np.abs(sent - np.asarray(seen["rgb"]) * 255).max() < 2
    assert {message.header.stamp for message in node.sent.values()} == {"now"}
    assert {message.header.frame_id for message in node.sent.values()} == {"camera_optical_frame"}
    assert (depth.encoding, color.encoding) == ("32FC1", "rgb8")
    assert np.isnan(np.frombuffer(depth.data, "<f4")).any()  # where nothing is measured (REP 118)
    labels = node.sent["labels/image_raw"]
    assert labels.encoding == "32SC1"
    assert set(np.frombuffer(labels.data, "<i4")) == {-1, 0, 1}  # nothing, world, cup
    info = node.sent["color/camera_info"]
    assert (info.height, info.width, info.distortion_model) == (24, 32, "plumb_bob")
    assert node.sent["color/camera_info"].k[0] == 30.0
    assert node.period == 0.1
    node.sent.clear()
    monkeypatch.setitem(POSES, "cup", None)
    node.publish()  # tf does not know a frame yet
    assert node.sent == {}
    assert "no picture yet" in node.warned
