"""Functions with a batch rule of their own, for kernels that compute a batch faster than element by element.

`jax.custom_batching.custom_vmap` is such a function, but reverse mode does not go through it. A call here is
one JAX primitive whose derivatives are those of the function for one element, and of what the batch rule
returns.
"""

from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Places = tuple[int | None, ...]  # 0 where an array has the axis of a batch, None where the batch shares it


@runtime_checkable
class Batchable(Protocol):
    """A function of arrays, and of a batch of them. It must be hashable."""

    def one(self, *arrays: Array) -> tuple[Array, ...]:
        """Returns the results for one element. Must be differentiable by JAX."""
        ...

    def batch(self, size: int, places: Places, arrays: tuple[Array, ...]) -> tuple[Array, ...] | None:
        """Returns the results for a batch, with a leading axis, or None to let `jax.vmap` of `one` do it.

        What it returns must be differentiable by JAX.

        Args:
            size: of the batch.
            places: which arrays have the axis of the batch.
            arrays: the arguments.
        """
        ...


def batchable_call(
    function: Batchable, arrays: tuple[Array, ...], types: tuple[Any, ...]
) -> tuple[Array, ...]:
    """Returns `function.one(*arrays)`; inside `jax.vmap`, the function's own batch rule applies.

    Args:
        function: the function.
        arrays: its arguments.
        types: the types that it returns, as `jax.typeof` of arrays.
    """
    return tuple(batchable_p.bind(*arrays, function=function, types=types))


def _one(*arrays: Array, function: Batchable, types: Any) -> list[Array]:
    return list(function.one(*arrays))


def _jvp(primals: Any, tangents: Any, *, function: Batchable, types: Any) -> Any:
    moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]

    def of_moving(*values: Array) -> list[Array]:
        arrays = list(primals)
        for i, value in zip(moving, values, strict=True):
            arrays[i] = value
        return _one(*arrays, function=function, types=types)

    return jax.jvp(of_moving, [primals[i] for i in moving], [tangents[i] for i in moving])


def _batch(arrays: Any, dims: Any, *, function: Batchable, types: Any) -> Any:
    (size,) = {array.shape[dim] for array, dim in zip(arrays, dims, strict=True) if dim is not None}
    moved = tuple(
        array if dim is None else jnp.moveaxis(array, dim, 0) for array, dim in zip(arrays, dims, strict=True)
    )
    places = tuple(None if dim is None else 0 for dim in dims)
    found = function.batch(size, places, moved)
    if found is None:
        found = tuple(jax.vmap(function.one, places)(*moved))
    return list(found), [0] * len(found)


batchable_p = Primitive("splatax_batchable")
batchable_p.multiple_results = True
batchable_p.def_impl(_one)
batchable_p.def_abstract_eval(lambda *_, types, **__: list(types))
ad.primitive_jvps[batchable_p] = _jvp
batching.primitive_batchers[batchable_p] = _batch
mlir.register_lowering(batchable_p, mlir.lower_fun(_one, multiple_results=True))
