"""Camera trajectories for videos: around the subject of a capture, past its cameras, or through keyframes."""

from splatax.trajectories.interpolation import Keyframe as Keyframe
from splatax.trajectories.interpolation import interpolate as interpolate
from splatax.trajectories.keyframes import read as read
from splatax.trajectories.keyframes import write as write
from splatax.trajectories.shapes import orbit as orbit
from splatax.trajectories.shapes import overview as overview
from splatax.trajectories.shapes import spiral as spiral
from splatax.trajectories.tour import tour as tour
