"""Cameras: one camera, and the geometry of the set of cameras that took a capture."""

from splatax.cameras.camera import Camera as Camera
from splatax.cameras.camera import checked as checked
from splatax.cameras.camera import look_at as look_at
