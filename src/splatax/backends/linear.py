"""Derivatives in both modes for kernels that JAX cannot differentiate itself.

`jax.custom_vjp` gives up forward mode, and `jax.custom_jvp` needs a tangent that JAX can transpose.
`linear_call` is such a tangent: a linear map with a transpose of its own. A kernel is differentiable in both
modes with

    @jax.custom_jvp
    def kernel(x): ...

    @kernel.defjvp
    def _(primals, tangents):
        out, residuals = ...
        return out, linear_call(map, residuals, tangents, out)

It is one JAX primitive, so `jit`, `vmap`, `scan`, `checkpoint`, `shard_map`, `linearize` and `jvp` of a
gradient work as for the functions of JAX.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Dims = tuple[int | None, ...]  # 0 where an array has the axis of a batch, None where the batch shares it


@runtime_checkable
class LinearMap(Protocol):
    """A linear map from tangents to tangents, at a point that its residuals describe. It must be hashable."""

    def apply(self, residuals: Any, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the outputs. Must be differentiable by JAX in residuals and tangents."""
        ...

    def transpose(self, residuals: Any, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the cotangents of the inputs: the transpose of `apply`."""
        ...

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> "LinearMap | None":
        """Returns a faster map for a batch, or None for the one that `jax.vmap` makes.

        Args:
            size: of the batch.
            residuals: the dimensions of the leaves of the residuals.
            tangents: the dimensions of the tangents.
        """
        ...


def linear_call(
    linear_map: LinearMap, residuals: Any, tangents: tuple[Array, ...], outputs: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Applies a linear map that has its own transpose.

    Args:
        linear_map: the map.
        residuals: a pytree of arrays that describe the point.
        tangents: what the map is linear in.
        outputs: arrays of the types that the map returns.
    """
    leaves, structure = jax.tree.flatten(residuals)
    types = tuple(jax.typeof(array) for array in outputs)
    return tuple(linear_p.bind(*leaves, *tangents, linear_map=linear_map, structure=structure, types=types))


@dataclass(frozen=True)
class Batched:
    """A linear map for each element of a batch, by `jax.vmap`.

    Attributes:
        inner: the map of one element.
        structure: of the inner map's residuals.
        residuals, tangents: which of their arrays have the axis of the batch.
    """

    inner: LinearMap
    structure: Any
    residuals: Dims
    tangents: Dims

    def apply(self, residuals: Any, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Applies the inner map to each element."""

        def one(leaves: list[Array], tangents: tuple[Array, ...]) -> tuple[Array, ...]:
            return self.inner.apply(jax.tree.unflatten(self.structure, leaves), tangents)

        return jax.vmap(one, (list(self.residuals), self.tangents))(jax.tree.leaves(residuals), tangents)

    def transpose(self, residuals: Any, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Transposes the inner map for each element, and sums over the batch what it shares."""

        def one(leaves: list[Array], cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
            return tuple(self.inner.transpose(jax.tree.unflatten(self.structure, leaves), cotangents))

        each = jax.vmap(one, (list(self.residuals), 0))(jax.tree.leaves(residuals), cotangents)
        return tuple(
            jnp.sum(array, axis=0) if dim is None else array
            for array, dim in zip(each, self.tangents, strict=True)
        )

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> None:
        """Returns None: a batch of batches is one more `jax.vmap`."""


def _split(arrays: Any, structure: Any) -> tuple[Any, tuple[Any, ...]]:
    """Returns residuals and tangents."""
    count = structure.num_leaves
    return jax.tree.unflatten(structure, arrays[:count]), tuple(arrays[count:])


def _apply(*arrays: Array, linear_map: LinearMap, structure: Any, types: Any) -> list[Array]:
    return list(linear_map.apply(*_split(arrays, structure)))


def _jvp(primals: Any, tangents: Any, *, linear_map: LinearMap, structure: Any, types: Any) -> Any:
    parameters = {"linear_map": linear_map, "structure": structure, "types": types}
    out = linear_p.bind(*primals, **parameters)
    count = structure.num_leaves
    if all(isinstance(tangent, ad.Zero) for tangent in tangents[:count]):
        directions = map(ad.instantiate_zeros, tangents[count:])
        return out, linear_p.bind(*primals[:count], *directions, **parameters)
    moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]

    def of_moving(*values: Array) -> list[Array]:
        arrays = list(primals)
        for i, value in zip(moving, values, strict=True):
            arrays[i] = value
        return _apply(*arrays, **parameters)

    return jax.jvp(of_moving, [primals[i] for i in moving], [tangents[i] for i in moving])


def _transpose(
    cotangents: Any, *arrays: Any, linear_map: LinearMap, structure: Any, types: Any
) -> list[Array | None]:
    residuals, tangents = _split(arrays, structure)
    found = linear_map.transpose(residuals, tuple(map(ad.instantiate_zeros, cotangents)))
    wanted = [
        value if ad.is_undefined_primal(tangent) else None
        for value, tangent in zip(found, tangents, strict=True)
    ]
    return [None] * structure.num_leaves + wanted


def _batch(arrays: Any, dims: Any, *, linear_map: LinearMap, structure: Any, types: Any) -> Any:
    (size,) = {array.shape[dim] for array, dim in zip(arrays, dims, strict=True) if dim is not None}
    arrays = [
        array if dim is None else jnp.moveaxis(array, dim, 0) for array, dim in zip(arrays, dims, strict=True)
    ]
    places = tuple(None if dim is None else 0 for dim in dims)
    own, tangents = places[: structure.num_leaves], places[structure.num_leaves :]
    map_of_batch = linear_map.batched(size, own, tangents)
    if map_of_batch is None:
        map_of_batch = Batched(linear_map, structure, own, tangents)
    types = tuple(kind.update(shape=(size, *kind.shape)) for kind in types)
    out = linear_p.bind(*arrays, linear_map=map_of_batch, structure=structure, types=types)
    return out, [0] * len(out)


linear_p = Primitive("splatax_linear")
linear_p.multiple_results = True
linear_p.def_impl(_apply)
linear_p.def_abstract_eval(lambda *_, types, **__: list(types))
ad.primitive_jvps[linear_p] = _jvp
ad.primitive_transposes[linear_p] = _transpose
batching.primitive_batchers[linear_p] = _batch
mlir.register_lowering(linear_p, mlir.lower_fun(_apply, multiple_results=True))
