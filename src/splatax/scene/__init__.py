"""Scenes of named parts, which are placed, hidden and coloured without a copy of their Gaussians."""

from splatax.scene.colors import ColorMap as ColorMap
from splatax.scene.parts import Part as Part
from splatax.scene.parts import Scene as Scene
from splatax.scene.seen import Drawable as Drawable
from splatax.scene.variants import Option as Option
from splatax.scene.variants import Variants as Variants
from splatax.scene.variants import chosen as chosen
