"""Photos or a video -> a capture: structure from motion by COLMAP, through pycolmap."""

from splatax.reconstruction.pipeline import Outcome as Outcome
from splatax.reconstruction.pipeline import reconstruct as reconstruct
