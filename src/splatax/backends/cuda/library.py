"""Calls the handlers of the CUDA backend (C++, in `native/cuda/` of the repository) from JAX."""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array

from splatax.backends import foreign

FOLDER = Path(__file__).parent
SYMBOLS = (
    "splatax_cuda_rasterize",
    "splatax_cuda_rasterize_gradient",
    "splatax_cuda_project",
    "splatax_cuda_project_gradient",
    "splatax_cuda_photometric",
    "splatax_cuda_move",
)


@dataclass(frozen=True)
class Library:
    """The handlers, and the device that they run on.

    Attributes:
        path: file of the library.
        platform: XLA's name of the device: "CUDA"; "cpu" where tests emulate one.
        prepare: gives driver and kernels to the loaded library; called once, before the first call.
    """

    path: Path
    platform: str
    prepare: Callable[[ctypes.CDLL], None]

    def call(
        self,
        symbol: str,
        shapes: Sequence[foreign.Shape],
        arrays: Sequence[Array],
        aliases: Mapping[int, int] | None = None,
        /,
        **options: np.int64 | np.float32,
    ) -> Sequence[Array]:
        """Calls a handler; see `splatax.backends.foreign.call`."""
        register(self)
        return foreign.call(symbol, shapes, arrays, options, aliases=aliases)


@cache
def register(library: Library) -> None:
    """Registers all handlers of a library with XLA.

    Raises:
        OSError: if the library or the driver cannot be loaded.
        JaxRuntimeError: if XLA refuses the handlers, because they were built for a newer XLA.
    """
    if library.platform == "cpu":
        jax.local_devices(backend="cpu")  # a handler that is refused while a backend starts takes it along
    loaded = load(library.path)
    library.prepare(loaded)
    for symbol in SYMBOLS:
        capsule = jax.ffi.pycapsule(getattr(loaded, symbol))
        jax.ffi.register_ffi_target(symbol, capsule, platform=library.platform)


@cache
def load(path: Path) -> ctypes.CDLL:
    """Loads a library, without its driver."""
    loaded = ctypes.CDLL(str(path))
    loaded.splatax_cuda_open.restype = ctypes.c_char_p
    loaded.splatax_cuda_load.restype = ctypes.c_char_p
    loaded.splatax_cuda_load.argtypes = [ctypes.c_int, ctypes.c_char_p]
    loaded.splatax_cuda_take_profile.restype = ctypes.c_char_p
    return loaded


def check(message: bytes) -> None:
    """Raises OSError if a function of the library has returned a message."""
    if message:
        raise OSError(message.decode())
