"""An example node for ROS 2: publishes what an RGB-D camera would see in a scene of parts.

    python docs/ros2_twin_node.py --ros-args -p scene:=lab.glb -p camera_frame:=camera_optical_frame

The scene is a .glb file in metres whose parts are named after tf frames, in the coordinates of these frames
(`splatax.twins.attached` makes such a scene). The node looks up the poses of the frames and of the camera in
tf, and publishes sensor_msgs/Image and CameraInfo. It needs ROS 2 with rclpy and tf2_ros in the same
environment as splatax. It was not run under ROS: its test replaces the modules of ROS by small doubles.
"""

import jax
import jax.numpy as jnp
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformException, TransformListener

import splatax as sx
from splatax.sensors import Color, Depth, Labels, observe
from splatax.twins.messages import camera_info_fields, image_fields, pose_from

SENSORS = {
    "color/image_raw": Color(),
    "depth/image_raw": Depth(invalid=float("nan")),  # as REP 118 has it for floats
    "labels/image_raw": Labels(),
}


class TwinNode(Node):
    """Publishes color, depth and labels at a fixed rate."""

    def __init__(self) -> None:
        super().__init__("splatax_twin")
        defaults = {
            "scene": "scene.glb",
            "world_frame": "world",
            "camera_frame": "camera_optical_frame",
            "width": 128,
            "height": 128,
            "focal": 140.0,  # pixels
            "rate": 10.0,  # frames a second
        }
        given = {name: self.declare_parameter(name, value).value for name, value in defaults.items()}
        self.world, self.eye = given["world_frame"], given["camera_frame"]
        self.scene = sx.load_scene(given["scene"])
        self.camera = sx.Camera.simple_pinhole(given["focal"], jnp.eye(4), given["width"], given["height"])
        self.measure = jax.jit(lambda scene, camera: observe(scene, camera, SENSORS))  # compiled once
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.images = {name: self.create_publisher(Image, name, 1) for name in SENSORS}
        self.info = self.create_publisher(CameraInfo, "color/camera_info", 1)
        self.create_timer(1 / given["rate"], self.publish)

    def pose(self, frame: str):
        """Returns the newest pose of a frame in the world."""
        found = self.buffer.lookup_transform(self.world, frame, Time()).transform
        place, turn = found.translation, found.rotation
        return pose_from(np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w]))

    def publish(self) -> None:
        """Measures once, and publishes the measurements with one time stamp."""
        try:
            poses = {
                name: self.pose(name).cast(jnp.float32) for name in self.scene.names if name != self.world
            }
            eye = self.pose(self.eye)
        except TransformException as error:
            self.get_logger().warning(f"no picture yet: {error}", throttle_duration_sec=5.0)
            return
        camera = eye.transform_camera(self.camera)
        found = self.measure(self.scene.posed(poses), camera)
        stamp = self.get_clock().now().to_msg()
        for name, publisher in self.images.items():
            publisher.publish(self.filled(Image(), stamp, image_fields(found[name])))
        self.info.publish(self.filled(CameraInfo(), stamp, camera_info_fields(camera)))

    def filled(self, message, stamp, fields):
        """Returns a message with a header and these fields."""
        message.header.stamp, message.header.frame_id = stamp, self.eye
        for name, value in fields.items():
            setattr(message, name, value)
        return message


def main() -> None:
    rclpy.init()
    node = TwinNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
