"""Camera paths for films: around what a capture looks at, or through its cameras."""

from splatax.trajectories.interpolation import Key as Key
from splatax.trajectories.interpolation import interpolate as interpolate
from splatax.trajectories.keyframes import read as read
from splatax.trajectories.keyframes import write as write
from splatax.trajectories.shapes import orbit as orbit
from splatax.trajectories.shapes import overview as overview
from splatax.trajectories.shapes import spiral as spiral
from splatax.trajectories.tour import tour as tour
