"""Mesh axes over which arrays vary inside `jax.shard_map`.

JAX keeps them in an array's type and requires that the operands of loops and of foreign functions agree.
Outside `shard_map`, and with `check_vma=False`, no array varies and the functions here return their input.
"""

from typing import Any

import jax
from jax import lax


def varying_axes(*trees: Any) -> frozenset[str]:
    """Returns the mesh axes over which any array of the trees varies."""
    return frozenset().union(*(_axes(leaf) for leaf in jax.tree.leaves(trees)))


def vary_over(axes: frozenset[str], tree: Any) -> Any:
    """Returns a tree of the same arrays, typed as varying over these mesh axes too.

    The transpose of this cast is a sum over the axes, so the gradient with respect to an array that all
    devices share is the sum of the devices' contributions.
    """

    def cast(leaf):
        missing = tuple(sorted(axes - _axes(leaf)))
        return lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(cast, tree) if axes else tree


def vary_together(*trees: Any) -> tuple[Any, ...]:
    """Returns trees whose arrays all vary over the mesh axes over which any of them varied."""
    return vary_over(varying_axes(*trees), trees)


def _axes(leaf: Any) -> frozenset[str]:
    return jax.typeof(leaf).manual_axis_type.varying
