"""The native library (C++, in `native/` of the repository), and calls into it from JAX.

There is a build of it for each instruction set, beside this file. They know nothing of Python and
link to nothing: XLA calls them as foreign functions.
"""

import ctypes
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

FOLDER = Path(__file__).parent
SUFFIX = {"Darwin": ".dylib", "Windows": ".dll"}.get(platform.system(), ".so")
INSTRUCTIONS = ("avx512", "avx2", "baseline")  # fastest first; a machine that runs one runs those after it
ALL_THREADS = 0


@dataclass(frozen=True)
class Build:
    """One build of the library, and how many threads of XLA's pool it may use.

    Attributes:
        instructions: its instruction set.
        threads: 0 for all. Results do not depend on it.
    """

    instructions: str
    threads: int = ALL_THREADS

    def call(
        self,
        symbol: str,
        shapes: Sequence[tuple[int, ...] | jax.ShapeDtypeStruct],
        arrays: Sequence[Array],
        **options: np.int64 | np.float32,
    ) -> Sequence[Array]:
        """Calls a function of the library.

        Args:
            symbol: its name.
            shapes: of the arrays that it returns; float32 unless they say otherwise.
            arrays: float32, but for tickets that a function has returned.
            options: further arguments, static under `jit`.
        """
        target = register(self.instructions, symbol)
        results = [
            shape if isinstance(shape, jax.ShapeDtypeStruct) else jax.ShapeDtypeStruct(shape, jnp.float32)
            for shape in shapes
        ]
        return jax.ffi.ffi_call(target, results, vmap_method="sequential")(
            *arrays, threads=np.int64(self.threads), **options
        )


def why_unavailable(instructions: str | None) -> str | None:
    """Why a build cannot run here, or any build where `instructions` is None; None if it can."""
    if jax.default_backend() != "cpu":
        return f"it runs on CPUs, and JAX runs on {jax.default_backend()} here"
    if not library_path("baseline").exists():
        return (
            "this installation has no native library, because it could not be built; install a C++ "
            "compiler, then splatax again"
        )
    best = best_instructions()
    if instructions is not None and instructions not in INSTRUCTIONS[INSTRUCTIONS.index(best) :]:
        return f"this machine has no {instructions}"
    if not library_path(instructions or best).exists():
        return f"there is no build of the native library for {instructions or best}"
    return None


@cache
def register(instructions: str, symbol: str) -> str:
    """Tells XLA of a function of a build; returns the name it has there."""
    target = f"{symbol}_{instructions}"
    function = getattr(library(instructions), symbol)
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(function), platform="cpu")
    return target


@cache
def library(instructions: str) -> ctypes.CDLL:
    """Loads a build."""
    return ctypes.CDLL(str(library_path(instructions)))


def library_path(instructions: str) -> Path:
    return FOLDER / f"libsplatax_{instructions}{SUFFIX}"


@cache
def best_instructions() -> str:
    """The fastest instruction set that this machine has."""
    function = library("baseline").splatax_best_instructions
    function.restype = ctypes.c_char_p
    return function().decode()
