"""Pytrees of different classes have different structures, whatever their leaves are."""

from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import splatax as sx
from splatax.cameras.lenses import Equirectangular, Orthographic, Pinhole
from splatax.pytrees import pytree

SOURCE = Path(sx.__file__).parent


@pytree
@dataclass(frozen=True)
class Pair:
    left: object
    right: object
    name: str = field(default="", metadata={"static": True})


@pytree
@dataclass(frozen=True)
class Couple(Pair):
    """The same fields in another class."""


@pytest.mark.parametrize(
    ("one", "other"),
    [*combinations((Pinhole(), Orthographic(), Equirectangular()), 2), (Pair(1, 2), Couple(1, 2))],
)
def test_equal_leaves_in_different_classes_are_different_trees(one, other):
    assert jax.tree.structure(one) != jax.tree.structure(other)
    assert jax.tree.structure(one) == jax.tree.structure(one)


def test_no_class_is_registered_in_a_way_that_jax_does_not_tell_apart():
    pages = [path for path in SOURCE.rglob("*.py") if path.name != "pytrees.py"]
    assert len(pages) > 100
    assert not [path.name for path in pages if "register_dataclass" in path.read_text()]


def test_each_lens_has_its_own_program_for_every_shape_of_other_arguments():
    point = jnp.array([1.0, 2.0, 4.0])
    for n in range(40):
        project = jax.jit(lambda lens, point, _: lens.project(point))
        others = jnp.zeros(n)
        assert project(Pinhole(), point, others)[0] == 0.25
        assert project(Orthographic(), point, others)[0] == 1


def test_static_fields_are_part_of_the_structure_and_children_have_names():
    tree = Pair(1.0, {"a": 2.0}, name="x")
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    assert [(jax.tree_util.keystr(path), leaf) for path, leaf in leaves] == [
        (".left", 1.0),
        (".right['a']", 2.0),
    ]
    assert structure != jax.tree.structure(Pair(1.0, {"a": 2.0}, name="y"))
    assert jax.tree.map(lambda x: x + 1, tree) == Pair(2.0, {"a": 3.0}, name="x")
