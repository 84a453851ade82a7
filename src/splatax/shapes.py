"""Checks the shapes and dtypes of arrays that enter the library, at trace time, and numbers that files hold.

Shapes use the notation of jaxtyping: "n 3" is any number of rows of three, and a letter stands for the same
number in all arrays of a call. Native code checks shapes again.
"""

import sys
from collections.abc import Mapping
from functools import lru_cache
from types import UnionType
from typing import Any, TypeGuard

import jax
import numpy as np

COMPUTED_IN = ("float32", "float64")
LONGEST_SIDE = 1_000_000  # pixels; kernels count tiles in 16 bits


def is_number(value: Any) -> TypeGuard[float]:
    """Returns whether a value that a file holds is a finite number, which truth values are not."""
    sort = isinstance(value, int | float) and not isinstance(value, bool)
    return sort and abs(value) <= sys.float_info.max  # also for integers that no float holds


def check_kind(name: str, value: Any, kind: type | UnionType, way_out: str) -> None:
    """Checks the kind of an argument, so that a mistake is named where it was made.

    Args:
        name: of the argument, for the message.
        value: the argument.
        kind: what it must be an instance of.
        way_out: sentence that says what to give instead.

    Raises:
        TypeError: if it is of another kind.
    """
    if not isinstance(value, kind):
        found = f"the text {value!r}" if isinstance(value, str) else f"of the type {type(value).__name__}"
        raise TypeError(f"{name} is {found}. {way_out}")


def check_arrays(owner: str, arrays: Mapping[str, tuple[Any, str]]) -> Mapping[str, int]:
    """Checks that arrays have the expected shapes, and one floating-point dtype.

    Args:
        owner: owner of the arrays for the message, such as "Gaussians".
        arrays: name -> (array, expected shape). The first array that has a letter in its shape defines
            the number that the letter stands for.

    Returns:
        The number of each letter.

    Raises:
        ValueError: if an array does not fit. The message names the array, its shape and the expected shape.
    """
    described = tuple(
        (name, *_described(owner, name, array), words) for name, (array, words) in arrays.items()
    )
    return _sizes(owner, described)


def check_dtypes(owner: str, arrays: Mapping[str, Any]) -> np.dtype:
    """Checks that arrays are all float32, or all float64, and returns that dtype.

    Raises:
        ValueError: if one is of another kind, or two differ.
    """
    return _dtype(owner, tuple((name, _described(owner, name, array)[1]) for name, array in arrays.items()))


Described = tuple[str, tuple[int, ...], np.dtype | None, str]  # name, shape, dtype, expected shape


@lru_cache  # callers check the same shapes again and again: a viewer, an evaluation
def _sizes(owner: str, described: tuple[Described, ...]) -> Mapping[str, int]:
    found = {name: (shape, words.split()) for name, shape, _, words in described}
    axes = {len(shape) - len(words) for shape, words in found.values()}
    if axes == {1} and len({shape[0] for shape, _ in found.values()}) == 1:
        raise ValueError(
            f"{owner}: every array has one axis more than it should have, such as {_example(found)}. "
            "This takes one at a time: use jax.vmap for a batch."
        )
    sizes: dict[str, int] = {}
    bound_by: dict[str, str] = {}
    for name, (shape, words) in found.items():
        for word in words[: len(shape)]:
            if not word.isdigit() and word not in sizes and len(shape) == len(words):
                sizes[word] = shape[words.index(word)]
                bound_by[word] = name
        wanted = tuple(int(word) if word.isdigit() else sizes.get(word, word) for word in words)
        if shape != wanted:
            raise ValueError(_mismatch(owner, name, shape, words, bound_by, sizes))
    _dtype(owner, tuple((name, dtype) for name, _, dtype, _ in described))
    return sizes


@lru_cache
def _dtype(owner: str, dtypes: tuple[tuple[str, np.dtype | None], ...]) -> np.dtype:
    first: tuple[str, np.dtype] | None = None
    for name, dtype in dtypes:
        if dtype is None:
            continue  # a Python number takes the dtype of what it meets
        if dtype.name not in COMPUTED_IN:
            raise ValueError(
                f"{owner}: {name} is {dtype.name}, and splatax computes in float32 or float64. Convert it: "
                f"{name}.astype(jnp.float32)."
            )
        if first is not None and dtype != first[1]:
            raise ValueError(
                f"{owner}: {name} is {dtype.name}, but {first[0]} is {first[1].name}. "
                "Give all arrays one dtype."
            )
        first = first or (name, dtype)
    if first is None:
        raise ValueError(
            f"{owner}: all of {', '.join(name for name, _ in dtypes)} are Python numbers, not arrays."
        )
    return first[1]


def check_size(owner: str, width: Any, height: Any) -> None:
    """Checks that the size of an image, in pixels, can be drawn.

    Raises:
        ValueError: if a side is not a positive Python integer, or is above 1,000,000.
    """
    for name, side in (("width", width), ("height", height)):
        if isinstance(side, bool) or not isinstance(side, int) or not 1 <= side <= LONGEST_SIDE:
            raise ValueError(
                f"{owner}: {name} is {side!r}, but it must be a whole number of pixels from "
                f"1 to {LONGEST_SIDE:,}."
            )


def _described(owner: str, name: str, array: Any) -> tuple[tuple[int, ...], np.dtype | None]:
    """Returns the shape of an array, and the dtype that JAX computes in for it; None for a Python number."""
    if isinstance(array, int | float) and not isinstance(array, bool):
        return (), None
    if not isinstance(array, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
        raise ValueError(
            f"{owner}: {name} is {type(array).__name__}, not an array. Convert it: jnp.asarray({name})."
        )
    return tuple(array.shape), jax.dtypes.canonicalize_dtype(array.dtype)


def _mismatch(
    owner: str,
    name: str,
    shape: tuple[int, ...],
    words: list[str],
    bound_by: Mapping[str, str],
    sizes: Mapping[str, int],
) -> str:
    wanted = "(" + ", ".join(words) + ("," if len(words) == 1 else "") + ")"
    letters = [word for word in words if not word.isdigit() and word in sizes]
    known = ", ".join(
        f"{word} is {sizes[word]}" + (f" in {bound_by[word]}" if word in bound_by else "") for word in letters
    )
    where = f", where {known}" if known else ""
    return f"{owner}: {name} has shape {shape}, but it must have shape {wanted}{where}."


def _example(found: Mapping[str, tuple[tuple[int, ...], list[str]]]) -> str:
    name, (shape, words) = next(iter(found.items()))
    return f"{name} of shape {shape} instead of ({', '.join(words)})"
