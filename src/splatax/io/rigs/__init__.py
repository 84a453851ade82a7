"""Files of rigs: bodies and rigged scenes as .glb, and poses of photos as .json."""

from splatax.io.rigs.bodies import read_body as read_body
from splatax.io.rigs.poses import Posing as Posing
from splatax.io.rigs.poses import along_clip as along_clip
from splatax.io.rigs.poses import read_poses as read_poses
from splatax.io.rigs.poses import write_poses as write_poses
from splatax.io.rigs.scenes import load_animated as load_animated
from splatax.io.rigs.scenes import load_rigged as load_rigged
from splatax.io.rigs.scenes import save_animated as save_animated
from splatax.io.rigs.scenes import save_rigged as save_rigged
from splatax.io.rigs.writing import save_body as save_body
