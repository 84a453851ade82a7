"""Reconstructs a capture from photos or a video: structure from motion with COLMAP, through pycolmap."""

from splatax.reconstruction.bundle import Adjustment as Adjustment
from splatax.reconstruction.bundle import adjusted_cameras as adjusted_cameras
from splatax.reconstruction.pipeline import Outcome as Outcome
from splatax.reconstruction.pipeline import reconstruct as reconstruct
from splatax.reconstruction.triangulation import triangulated as triangulated
