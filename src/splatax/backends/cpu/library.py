"""Loads the native library (C++, in `native/cpu/` of the repository) and calls it from JAX.

Beside this file there is a build for each instruction set, or the one for this machine alone, and a small
library that tells which instruction set is the best here. They do not depend on Python or on other libraries:
XLA calls them as foreign functions.
"""

import ctypes
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import jaxlib
import numpy as np
from jaxtyping import Array

from splatax.backends import foreign

FOLDER = Path(__file__).parent
SUFFIX = {"Darwin": ".dylib", "Windows": ".dll"}.get(platform.system(), ".so")
INSTRUCTIONS = ("avx512", "avx2", "baseline")  # fastest first; a machine that runs one runs those after it
CHOICE = "instructions"  # the library that knows the best of them
ALL_THREADS = 0


@dataclass(frozen=True)
class Build:
    """One build of the library, and how many threads of XLA's pool it may use.

    Attributes:
        instructions: its instruction set; None for the best that this machine has.
        threads: 0 for all. Results do not depend on it.
    """

    instructions: str | None = None
    threads: int = ALL_THREADS

    def call(
        self,
        symbol: str,
        shapes: Sequence[foreign.Shape],
        arrays: Sequence[Array],
        *,
        batches: bool = False,
        aliases: Mapping[int, int] | None = None,
        **options: np.int64 | np.float32 | np.ndarray,
    ) -> Sequence[Array]:
        """Calls a function of the library.

        Args:
            symbol: its name.
            shapes: of the arrays that it returns; float32 unless they say otherwise.
            arrays: float32, but for tickets that a function has returned. The library refuses other
                dtypes, and shapes that do not fit together.
            batches: whether the function takes leading axes of `jax.vmap`, of length 1 for arrays that a
                batch shares. If not, it is called once for each element.
            aliases: place of an argument -> place of the result that may take its memory.
            options: further arguments, static under `jit`.
        """
        target = register(self.instructions or best_instructions(), symbol)
        method = "expand_dims" if batches else "sequential"
        settings = {"threads": np.int64(self.threads), **options}
        return foreign.call(target, shapes, arrays, settings, method, aliases)


def why_unavailable(instructions: str | None) -> str | None:
    """Returns the reason why a build cannot run here, or None if it can.

    Args:
        instructions: of the build; None asks whether any build can.
    """
    if jax.default_backend() != "cpu":
        return f"it runs on CPUs, and JAX runs on {jax.default_backend()} here"
    if not library_path(CHOICE).exists():
        return (
            "this installation has no native library, because it could not be built; install a C++ "
            "compiler, then splatax again"
        )
    best = best_instructions()
    if instructions is not None and instructions not in INSTRUCTIONS[INSTRUCTIONS.index(best) :]:
        return f"this machine has no {instructions}"
    if not library_path(instructions or best).exists():
        return f"there is no build of the native library for {instructions or best}"
    return why_refused(instructions or best)


@cache
def why_refused(instructions: str) -> str | None:
    """Returns why the installed XLA does not accept the functions of a build; None if it does."""
    try:
        register(instructions, "splatax_rasterize_forward")
    except jax.errors.JaxRuntimeError as error:
        return (
            f"jaxlib {jaxlib.__version__} does not accept the native library, which was built with the "
            "headers of a newer one. Update jax, or install splatax again without --no-build-isolation. "
            f"The reason that JAX gives: {error}"
        )
    return None


@cache
def register(instructions: str, symbol: str) -> str:
    """Registers a function of a build with XLA, and returns the name it has there.

    Raises:
        JaxRuntimeError: if XLA refuses it, because it was built for a newer XLA.
    """
    # A function that is refused while JAX starts its CPU backend takes the whole backend with it.
    jax.local_devices(backend="cpu")
    target = f"{symbol}_{instructions}"
    function = getattr(library(instructions), symbol)
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(function), platform="cpu")
    return target


@cache
def library(name: str) -> ctypes.CDLL:
    """Loads a build, or the library that knows the best instruction set."""
    return ctypes.CDLL(str(library_path(name)))


def library_path(name: str) -> Path:
    """Returns the path of a library."""
    return FOLDER / f"libsplatax_{name}{SUFFIX}"


@cache
def best_instructions() -> str:
    """Returns the fastest instruction set that this machine has."""
    function = library(CHOICE).splatax_best_instructions
    function.restype = ctypes.c_char_p
    return function().decode()
