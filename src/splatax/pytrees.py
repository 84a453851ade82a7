"""Pytrees of dataclasses that JAX tells apart by their class.

jaxlib compares the structures of two trees without the classes of dataclasses that are registered with
`jax.tree_util.register_dataclass`: those of a pinhole and of an orthographic lens, which have no arrays, are
equal. Only their hashes differ, and a cache of `jit` looks at few bits of a hash before it asks for equality.
With jax 0.10.2, the second of two such lenses got the program of the first for 1.5 % of all shapes of other
arguments. Classes that are registered with functions are compared.
"""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, TypeVar, cast

import jax

Record = TypeVar("Record")


def pytree(cls: type[Record]) -> type[Record]:
    """Registers a dataclass as a pytree, as `jax.tree_util.register_dataclass` does. Use it as a decorator.

    Fields are children, apart from those with `metadata={"static": True}`, which must be hashable.
    """
    declared = fields(cast(Any, cls))
    traced = [field.name for field in declared if not field.metadata.get("static")]
    static = [field.name for field in declared if field.metadata.get("static")]
    keys = [jax.tree_util.GetAttrKey(name) for name in traced]

    def flatten(tree: Record) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(tree, name) for name in traced], tuple([getattr(tree, name) for name in static])

    def flatten_with_keys(tree: Record) -> tuple[list[Any], tuple[Any, ...]]:
        children, values = flatten(tree)
        return list(zip(keys, children, strict=True)), values

    def unflatten(values: tuple[Any, ...], children: Iterable[Any]) -> Record:
        return cls(**dict(zip(traced, children, strict=True)), **dict(zip(static, values, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls
