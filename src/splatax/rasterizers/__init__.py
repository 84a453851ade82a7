"""Rasterizer backends behind one function: `composite`.

A backend is a module, or an object in one, with `composite(splats, channels)` and
`why_unavailable()`; the contract suite in `tests/contracts/` says what it must do.
"""

import importlib
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
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


def resolve(backend: str = AUTO) -> str:
    """The name of the backend to use. Call it outside `jit`: the name is static inside.

    "auto" is the first available one for the default JAX platform. One asked for by name is never
    replaced by another.

    Raises:
        ValueError: if there is no such backend, or it cannot run here; the message says why.
    """
    if backend == AUTO:
        names = PREFERENCE.get(jax.default_backend(), PREFERENCE["gpu"])
        return next(name for name in names if implementation(name).why_unavailable() is None)
    if backend not in BACKENDS:
        raise ValueError(f"no rasterizer backend {backend!r}: choose from {', '.join([AUTO, *BACKENDS])}")
    reason = implementation(backend).why_unavailable()
    if reason is not None:
        raise ValueError(f"rasterizer backend {backend!r} is not available: {reason}")
    return backend


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
    differentiable; to render depth, pass it as a channel.

    Args:
        splats: their `colors` are not used: pass them as channels.
        channels: what to blend, any number of them.
        backend: see `resolve`.

    Returns:
        The sums over splats of weight times channel, and the sums of weights (alpha).
    """
    if splats.means2d.shape[0] == 0:
        size, dtype = (splats.height, splats.width), splats.means2d.dtype
        return jnp.zeros((*size, channels.shape[1]), dtype), jnp.zeros(size, dtype)
    return _composite(splats, channels, resolve(backend))


@partial(jax.jit, static_argnames="backend")
def _composite(splats: Splats, channels: Float[Array, "n c"], backend: str):
    return implementation(backend).composite(splats, channels)
