"""Derivatives in both modes for kernels that JAX cannot differentiate itself.

`jax.custom_vjp` does not support forward mode, and `jax.custom_jvp` needs a tangent that JAX can transpose.
`linear_call` is such a tangent: a linear map with a transpose of its own. A kernel is differentiable in both
modes with

    @jax.custom_jvp
    def kernel(x): ...

    @kernel.defjvp
    def _(primals, tangents):
        out, residuals = ...
        return out, linear_call(map, residuals, tangents, out)

It is one JAX primitive, so `jit`, `vmap`, `scan`, `checkpoint`, `shard_map`, `linearize`, `jvp` of a
gradient and the gradient of a `jvp` work as for the functions of JAX.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

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

    def batched(self, each: "Batched") -> "OfBatch | None":
        """Returns a faster map for a batch than `each`, which `jax.vmap` makes; None if there is none."""
        ...


@runtime_checkable
class Curved(LinearMap, Protocol):
    """A linear map that JAX cannot transpose in its residuals, as where `apply` has `while` loops."""

    def curvature(self, residuals: Any, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]) -> Any:
        """Returns the gradient of <cotangents, apply(residuals, tangents)> with respect to the residuals.

        It has the structure of the residuals; leaves of integers may be anything.
        """
        ...


class OfBatch(NamedTuple):
    """A linear map of a batch.

    Attributes:
        linear_map: the map, whose arguments have the batch as their first axis.
        axis: that of the batch in what it returns, 0 or -1.
    """

    linear_map: LinearMap
    axis: int = 0


def curvature(
    linear_map: LinearMap, residuals: Any, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]
) -> Any:
    """Returns the gradient of <cotangents, apply(residuals, tangents)> with respect to the residuals."""
    if isinstance(linear_map, Curved):
        return linear_map.curvature(residuals, tangents, cotangents)
    leaves, structure = jax.tree.flatten(residuals)
    moving = [i for i, leaf in enumerate(leaves) if _moves(leaf)]

    def image(values: list[Array]) -> tuple[Array, ...]:
        return tuple(
            linear_map.apply(jax.tree.unflatten(structure, _replaced(leaves, moving, values)), tangents)
        )

    found = jax.vjp(image, [leaves[i] for i in moving])[1](tuple(cotangents))[0]
    return jax.tree.unflatten(structure, _replaced(leaves, moving, found))


def linear_call(
    linear_map: LinearMap, residuals: Any, tangents: tuple[Array, ...], outputs: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Applies a linear map that has its own transpose.

    Args:
        linear_map: the map.
        residuals: a pytree of arrays that describe the point.
        tangents: the arguments in which the map is linear.
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

    def batched(self, each: "Batched") -> None:
        """Returns None: a batch of batches is one more `jax.vmap`."""

    def curvature(self, residuals: Any, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]) -> Any:
        """Returns that of the inner map for each element, summed over the batch where it shares residuals."""

        def one(
            leaves: list[Array], tangents: tuple[Array, ...], cotangents: tuple[Array, ...]
        ) -> list[Array]:
            own = jax.tree.unflatten(self.structure, leaves)
            return jax.tree.leaves(curvature(self.inner, own, tangents, cotangents))

        leaves, structure = jax.tree.flatten(residuals)
        dims = (list(self.residuals), self.tangents, 0)
        each = jax.vmap(one, dims)(leaves, tuple(tangents), tuple(cotangents))
        summed = [
            jnp.sum(array, axis=0) if dim is None else array
            for array, dim in zip(each, self.residuals, strict=True)
        ]
        return jax.tree.unflatten(structure, summed)


@dataclass(frozen=True)
class Moving:
    """The change of what a linear map returns, at fixed tangents, when its residuals move. It is linear too.

    Attributes:
        inner: the map.
        structure: of its residuals.
        moving: which leaves of the residuals move.
    """

    inner: LinearMap
    structure: Any
    moving: tuple[int, ...]

    def apply(self, residuals: Any, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the change; the residuals are the leaves of those of the inner map, and its tangents."""
        leaves, own = residuals

        def image(*values: Array) -> tuple[Array, ...]:
            moved = _replaced(leaves, self.moving, values)
            return tuple(self.inner.apply(jax.tree.unflatten(self.structure, moved), own))

        return jax.jvp(image, [leaves[i] for i in self.moving], list(tangents))[1]

    def transpose(self, residuals: Any, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients in the leaves that move."""
        leaves, own = residuals
        found = curvature(self.inner, jax.tree.unflatten(self.structure, leaves), own, cotangents)
        gradients = jax.tree.leaves(found)
        return tuple(gradients[i] for i in self.moving)

    def batched(self, each: "Batched") -> None:
        """Returns None: the map of a batch is made by `jax.vmap`."""


def _moves(leaf: Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _replaced(leaves: Sequence[Array], places: Sequence[int], values: Sequence[Array]) -> list[Array]:
    found = list(leaves)
    for place, value in zip(places, values, strict=True):
        found[place] = value
    return found


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
    moving = tuple(i for i in range(count) if not isinstance(tangents[i], ad.Zero) and _moves(primals[i]))
    if not moving:
        directions = map(ad.instantiate_zeros, tangents[count:])
        return out, linear_p.bind(*primals[:count], *directions, **parameters)
    point = (tuple(primals[:count]), tuple(primals[count:]))
    turned = Moving(linear_map, structure, moving)
    change = linear_call(turned, point, tuple(tangents[i] for i in moving), tuple(out))
    if all(isinstance(tangent, ad.Zero) for tangent in tangents[count:]):
        return out, list(change)
    directions = map(ad.instantiate_zeros, tangents[count:])
    along = linear_p.bind(*primals[:count], *directions, **parameters)
    return out, [a + b for a, b in zip(along, change, strict=True)]


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
    each = Batched(linear_map, structure, own, tangents)
    of_batch = linear_map.batched(each) or OfBatch(each)
    shapes = [(size, *kind.shape) if of_batch.axis == 0 else (*kind.shape, size) for kind in types]
    types = tuple(kind.update(shape=shape) for kind, shape in zip(types, shapes, strict=True))
    out = linear_p.bind(*arrays, linear_map=of_batch.linear_map, structure=structure, types=types)
    return out, [of_batch.axis % len(shape) for shape in shapes]


linear_p = Primitive("splatax_linear")
linear_p.multiple_results = True
linear_p.def_impl(_apply)
linear_p.def_abstract_eval(lambda *_, types, **__: list(types))
ad.primitive_jvps[linear_p] = _jvp
ad.primitive_transposes[linear_p] = _transpose
batching.primitive_batchers[linear_p] = _batch
mlir.register_lowering(linear_p, mlir.lower_fun(_apply, multiple_results=True))
