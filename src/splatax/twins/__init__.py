"""Digital twins: scenes of parts that follow the bodies of a physics simulation.

bridge.py        poses of bodies and cameras of MuJoCo, as transforms and cameras of splatax
twin.py          `Twin`: a scene of parts, the cameras of a model, and their sensors
environment.py   `TwinEnv`, an environment of gymnasium; it needs the packages of the extra "twins"
locating.py      the pose of a part from one RGB-D frame, by gradient descent
messages.py      images, point clouds and poses as the fields of ROS 2 messages
"""

from splatax.twins.bridge import Frames as Frames
from splatax.twins.bridge import attached as attached
from splatax.twins.bridge import camera_of as camera_of
from splatax.twins.bridge import frames_of as frames_of
from splatax.twins.locating import LocationSearch as LocationSearch
from splatax.twins.locating import RgbdFrame as RgbdFrame
from splatax.twins.locating import located as located
from splatax.twins.locating import location_search as location_search
from splatax.twins.twin import Twin as Twin
