"""Rasterizer backends behind one function: `composite`.

A backend is a module, or an object in one, with `composite(splats, channels)` and
`why_unavailable()`; the contract suite in `tests/contracts/` says what it must do. It may have a
`project` too, and compute in single precision alone (`DOUBLE_PRECISION = False`).
"""

import importlib
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from splatax.splats import Splats

BACKENDS = {  # name -> module here, or module:object, imported on first use
    "reference": "reference",
    "xla": "xla",
    "cpu": "cpu:best",
    "cpu-avx512": "cpu:avx512",
    "cpu-avx2": "cpu:avx2",
    "cpu-baseline": "cpu:baseline",
}
PREFERENCE = {"cpu": ("cpu", "xla"), "gpu": ("xla",), "tpu": ("xla",)}  # what "auto" tries, by platform
AUTO = "auto"


@runtime_checkable
class Backend(Protocol):
    """What implements a backend."""

    def why_unavailable(self) -> str | None:
        """None if it can run here."""
        ...

    def composite(
        self, splats: Splats, channels: Float[Array, "n c"]
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
        """See `composite` below. There is at least one splat."""
        ...


def resolve(backend: str = AUTO, dtype: DTypeLike = jnp.float32) -> str:
    """The name of the backend to use. Call it outside `jit`: the name is static inside.

    "auto" is the first available one for the default JAX platform that computes in `dtype`. One
    asked for by name is never replaced by another.

    Raises:
        ValueError: if there is no such backend, or it cannot run here; the message says why.
    """
    if backend == AUTO:
        names = PREFERENCE.get(jax.default_backend(), PREFERENCE["gpu"])
        return next(name for name in names if why_unavailable(name, dtype) is None)
    if backend not in BACKENDS:
        raise ValueError(f"no rasterizer backend {backend!r}: choose from {', '.join([AUTO, *BACKENDS])}")
    reason = why_unavailable(backend, dtype)
    if reason is not None:
        raise ValueError(f"rasterizer backend {backend!r} is not available: {reason}")
    return backend


def why_unavailable(backend: str, dtype: DTypeLike = jnp.float32) -> str | None:
    """Why a backend cannot compute in `dtype` here; None if it can."""
    found = implementation(backend)
    if jnp.dtype(dtype) != jnp.float32 and not getattr(found, "DOUBLE_PRECISION", True):
        return f"it computes in float32, not in {jnp.dtype(dtype).name}"
    return found.why_unavailable()


def implementation(name: str) -> Backend:
    """What implements the backend of this name."""
    module, _, attribute = BACKENDS[name].partition(":")
    found = importlib.import_module(f"{__name__}.{module}")
    return getattr(found, attribute) if attribute else found


def composite(
    splats: Splats, channels: Float[Array, "n c"], *, backend: str = AUTO
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends any per-splat channels front to back into every pixel.

    Differentiable in means2d, sqrt_conics, opacities and channels. The order of depths is not
    differentiable; to render depth, pass it as a channel. Splats with `pull` get its gradient too.

    Args:
        splats: their `colors` are not used: pass them as channels.
        channels: what to blend, any number of them.
        backend: see `resolve`.

    Returns:
        The sums over splats of weight times channel, and the sums of weights (alpha).

    Raises:
        ValueError: if the backend is unknown, not available here, or cannot give the gradient of
            `pull` for so many channels.
    """
    if splats.means2d.shape[0] == 0:
        size, dtype = (splats.height, splats.width), splats.means2d.dtype
        return jnp.zeros((*size, channels.shape[1]), dtype), jnp.zeros(size, dtype)
    return _composite(splats, channels, resolve(backend, splats.means2d.dtype))


@partial(jax.jit, static_argnames="backend")
def _composite(splats: Splats, channels: Float[Array, "n c"], backend: str):
    return implementation(backend).composite(splats, channels)
