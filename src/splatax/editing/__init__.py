"""Edits of a finished scene: selecting and labelling Gaussians, merging, levelling, levels of detail."""

from splatax.editing.labelling import intersection_over_union as intersection_over_union
from splatax.editing.labelling import labels_of as labels_of
from splatax.editing.labelling import split_by_label as split_by_label
from splatax.editing.labelling import votes as votes
from splatax.editing.levels import coarser as coarser
from splatax.editing.levels import levels_of as levels_of
from splatax.editing.placing import level as level
from splatax.editing.placing import merge as merge
from splatax.editing.placing import reduce_degree as reduce_degree
from splatax.editing.selecting import Box as Box
from splatax.editing.selecting import Sphere as Sphere
from splatax.editing.selecting import clean as clean
from splatax.editing.selecting import crop as crop
from splatax.editing.selecting import simplify as simplify
from splatax.editing.selecting import visible_weights as visible_weights
