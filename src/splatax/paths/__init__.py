"""Camera paths for films: around what a capture looks at, or through its cameras."""

from splatax.paths.interpolation import Key as Key
from splatax.paths.interpolation import interpolate as interpolate
from splatax.paths.keyframes import read as read
from splatax.paths.keyframes import write as write
from splatax.paths.shapes import orbit as orbit
from splatax.paths.shapes import overview as overview
from splatax.paths.shapes import spiral as spiral
from splatax.paths.tour import tour as tour
