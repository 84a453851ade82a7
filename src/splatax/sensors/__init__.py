"""Simulated sensors: what cameras, depth cameras and LiDARs on a robot measure in a scene.

A new sensor is a small pytree in a file here, and a line in `SENSORS`. The line enrols it in the contract
suite, `tests/contracts/test_sensors.py`.
"""

from splatax.sensors.color import Color as Color
from splatax.sensors.color import ColorNoise as ColorNoise
from splatax.sensors.color import MotionBlur as MotionBlur
from splatax.sensors.depth import Depth as Depth
from splatax.sensors.depth import DepthNoise as DepthNoise
from splatax.sensors.depth import Normals as Normals
from splatax.sensors.depth import PointCloud as PointCloud
from splatax.sensors.depth import millimetres as millimetres
from splatax.sensors.labels import Labels as Labels
from splatax.sensors.lidar import Lidar as Lidar
from splatax.sensors.lidar import Scan as Scan
from splatax.sensors.lidar import spinning as spinning
from splatax.sensors.metres import in_metres as in_metres
from splatax.sensors.metres import kept_metres as kept_metres
from splatax.sensors.metres import load_in_metres as load_in_metres
from splatax.sensors.observing import observe as observe
from splatax.sensors.protocol import Sensor as Sensor
from splatax.sensors.rig import CameraRig as CameraRig

SENSORS: dict[str, type[Sensor]] = {
    "color": Color,
    "depth": Depth,
    "normals": Normals,
    "labels": Labels,
    "points": PointCloud,
    "lidar": Lidar,
}
