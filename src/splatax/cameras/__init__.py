"""Cameras: one camera, lenses, motion, and the geometry of the set of cameras that took a capture."""

from splatax.cameras.camera import Camera as Camera
from splatax.cameras.camera import checked as checked
from splatax.cameras.camera import look_at as look_at
from splatax.cameras.conventions import as_pinhole as as_pinhole
from splatax.cameras.conventions import from_colmap as from_colmap
from splatax.cameras.conventions import from_opencv as from_opencv
from splatax.cameras.conventions import from_opengl as from_opengl
from splatax.cameras.conventions import panorama as panorama
from splatax.cameras.conventions import to_colmap as to_colmap
from splatax.cameras.conventions import to_opencv as to_opencv
from splatax.cameras.conventions import to_opengl as to_opengl
from splatax.cameras.motion import RollingShutter as RollingShutter
