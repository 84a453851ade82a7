"""Scenes of named parts, and scenes that follow a skeleton."""

from splatax.scene.colors import ColorMap as ColorMap
from splatax.scene.parts import Part as Part
from splatax.scene.parts import Scene as Scene
from splatax.scene.rigged import AnimatedScene as AnimatedScene
from splatax.scene.rigged import RiggedScene as RiggedScene
from splatax.scene.seen import Drawable as Drawable
from splatax.scene.skeleton import Pose as Pose
from splatax.scene.skeleton import Skeleton as Skeleton
from splatax.scene.skin import Rig as Rig
from splatax.scene.skin import skin as skin
from splatax.scene.variants import Option as Option
from splatax.scene.variants import Variants as Variants
from splatax.scene.variants import chosen as chosen
