"""The native rasterizer: a C++ library (`native/` in the repository) behind XLA's foreign functions.

There is a build of it for each instruction set; `best` is the fastest that this machine can run.
Results do not depend on the number of threads. Computes in float32, whatever it is given.
"""

import ctypes
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.splats import Splats

FOLDER = Path(__file__).parent.parent / "native"
SUFFIX = {"Darwin": ".dylib", "Windows": ".dll"}.get(platform.system(), ".so")
INSTRUCTIONS = ("avx512", "avx2", "baseline")  # fastest first; a machine that runs one runs those after it
ALL_THREADS = 0
MAX_PAIRS = 2**22  # (splat, tile) pairs in a round: at most 260 MB, however large the scene


@dataclass(frozen=True)
class Native:
    """One build of the library.

    Attributes:
        instructions: its instruction set; None for the best that runs here.
        threads: how many to use, of those that XLA has; 0 for all.
        max_pairs: (splat, tile) pairs that are listed at a time.
    """

    instructions: str | None = None
    threads: int = ALL_THREADS
    max_pairs: int = MAX_PAIRS

    DOUBLE_PRECISION = False

    def why_unavailable(self) -> str | None:
        """None if it can run here."""
        if jax.default_backend() != "cpu":
            return f"it runs on CPUs, and JAX runs on {jax.default_backend()} here"
        if not library_path("baseline").exists():
            return (
                "this installation has no native library, because no C++ compiler was found when it was "
                "made; install a compiler, then splatax again"
            )
        available = INSTRUCTIONS[INSTRUCTIONS.index(best_instructions()) :]
        if self.instructions is not None and self.instructions not in available:
            return f"this machine has no {self.instructions}"
        if not library_path(self.instructions or best_instructions()).exists():
            return f"there is no build of the native library for {self.instructions or best_instructions()}"
        return None

    def composite(
        self, splats: Splats, channels: Float[Array, "n c"]
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
        """Blends `channels` of the splats, nearest first, into every pixel; see `rasterizers.composite`."""
        return _composite(
            splats, channels, replace(self, instructions=self.instructions or best_instructions())
        )


best = Native()
avx512, avx2, baseline = (Native(instructions) for instructions in INSTRUCTIONS)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _composite(splats: Splats, channels: Float[Array, "n c"], native: Native):
    return _forward(splats, channels, native)[0]


def _forward(splats: Splats, channels: Float[Array, "n c"], native: Native):
    h, w = splats.height, splats.width
    image = _call(native, "splatax_rasterize", [(h, w, channels.shape[1]), (h, w)], _inputs(splats, channels))
    sums, alpha = (array.astype(channels.dtype) for array in image)
    return (sums, alpha), (splats, channels, sums, alpha)


def _backward(native: Native, residuals, cotangents):
    splats, channels, *image = residuals
    shapes = [splats.means2d.shape, splats.sqrt_conics.shape, splats.opacities.shape, channels.shape]
    gradients = _call(
        native, "splatax_rasterize_gradient", shapes, [*_inputs(splats, channels), *image, *cotangents]
    )
    means2d, sqrt_conics, opacities, d_channels = (array.astype(channels.dtype) for array in gradients)
    d_splats = replace(
        jax.tree.map(jnp.zeros_like, splats), means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities
    )
    return d_splats, d_channels


_composite.defvjp(_forward, _backward)


def _inputs(splats: Splats, channels: Float[Array, "n c"]) -> list[Array]:
    return [
        splats.means2d,
        splats.sqrt_conics,
        splats.depths,
        splats.extents,
        splats.opacities,
        channels,
    ]


def _call(native: Native, symbol: str, shapes: list[tuple[int, ...]], arrays: list[Array]) -> Sequence[Array]:
    target = register(native.instructions, symbol)
    results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    call = jax.ffi.ffi_call(target, results, vmap_method="sequential")
    options = {"threads": np.int64(native.threads), "max_pairs": np.int64(native.max_pairs)}
    return call(*(array.astype(jnp.float32) for array in arrays), **options)


@cache
def register(instructions: str, symbol: str) -> str:
    """Tells XLA of a function of a build; returns the name it has there."""
    target = f"{symbol}_{instructions}"
    jax.ffi.register_ffi_target(
        target, jax.ffi.pycapsule(getattr(library(instructions), symbol)), platform="cpu"
    )
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
