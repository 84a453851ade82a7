"""Calls of foreign functions that are registered with XLA."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import ManualAxisType, NamedSharding, PartitionSpec
from jaxtyping import Array

from splatax.varying import vary_over, varying_axes

Shape = tuple[int, ...] | jax.ShapeDtypeStruct


def call(
    target: str,
    shapes: Sequence[Shape],
    arrays: Sequence[Array],
    options: Mapping[str, np.int64 | np.float32 | np.ndarray],
    vmap_method: str = "sequential",
    aliases: Mapping[int, int] | None = None,
) -> Sequence[Array]:
    """Calls a foreign function, also inside `jax.vmap` and `jax.shard_map`.

    Args:
        target: the name under which it is registered.
        shapes: of the arrays that it returns; float32 unless they say otherwise.
        arrays: its arguments. The function checks their dtypes and shapes.
        options: further arguments, static under `jit`.
        vmap_method: how `jax.vmap` calls it; see `jax.ffi.ffi_call`. By default once for each element.
        aliases: place of an argument -> place of the result that may take its memory.
    """
    axes = varying_axes(arrays)
    results = [_result(shape, axes) for shape in shapes]
    function = jax.ffi.ffi_call(
        target, results, vmap_method=vmap_method, input_output_aliases=dict(aliases or {})
    )
    return function(*vary_over(axes, tuple(arrays)), **options)


def _result(shape: Shape, axes: frozenset[str]) -> jax.ShapeDtypeStruct:
    """Returns the type of a result, which varies over the mesh axes that the arguments vary over."""
    if not isinstance(shape, jax.ShapeDtypeStruct):
        shape = jax.ShapeDtypeStruct(shape, jnp.float32)
    if not axes:
        return shape
    everywhere = NamedSharding(jax.sharding.get_abstract_mesh(), PartitionSpec())
    return jax.ShapeDtypeStruct(
        shape.shape, shape.dtype, sharding=everywhere, manual_axis_type=ManualAxisType(varying=axes)
    )
