"""Edits of a finished scene: selecting Gaussians, merging scenes, levelling, and reducing harmonics."""

from splatax.editing.placing import level as level
from splatax.editing.placing import merge as merge
from splatax.editing.placing import reduce_degree as reduce_degree
from splatax.editing.selecting import Box as Box
from splatax.editing.selecting import Sphere as Sphere
from splatax.editing.selecting import clean as clean
from splatax.editing.selecting import crop as crop
from splatax.editing.selecting import simplify as simplify
from splatax.editing.selecting import visible_weights as visible_weights
