"""Scenes of named parts, which are placed, hidden and coloured without a copy of their Gaussians."""

from splatax.scene.colors import ColorMap as ColorMap
from splatax.scene.parts import Part as Part
from splatax.scene.parts import Scene as Scene
from splatax.scene.seen import Drawable as Drawable
