"""The backends, and the one place that chooses between them.

A backend is a value, `Kernels`: a projection, a rasterizer and a loss. It is looked up by name once, outside
`jit`, and passed on as a value. The contract suites in `tests/contracts/` say what each kernel must do, and
run on every backend that has a line here.
"""

import importlib

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from splatax.backends.protocol import Kernels

BACKENDS = {  # name -> module:attribute, imported on first use
    "reference": "reference:KERNELS",
    "xla": "portable:KERNELS",
    "cuda": "cuda:KERNELS",
    "cpu": "cpu:BEST",
    "cpu-avx512": "cpu:AVX512",
    "cpu-avx2": "cpu:AVX2",
    "cpu-baseline": "cpu:BASELINE",
}
# what "auto" tries, by platform
PREFERENCE = {"cpu": ("cpu", "xla"), "gpu": ("cuda", "xla"), "tpu": ("xla",)}
AUTO = "auto"


def resolve(backend: str | Kernels = AUTO, dtype: DTypeLike = jnp.float32) -> Kernels:
    """Returns the kernels to compute with. Call it once, outside `jit`, and pass on what it returns.

    Args:
        backend: the name of a backend, or kernels of your own. "auto" is the first backend that runs on JAX's
            default platform and computes in `dtype`. A backend that is named is never replaced by another.
        dtype: dtype to compute in.

    Raises:
        ValueError: if there is no such backend, it cannot run here, or does not compute in `dtype`.
    """
    if backend == AUTO:
        names = PREFERENCE.get(jax.default_backend(), PREFERENCE["gpu"])
        return next(found for found in map(kernels, names) if why_unavailable(found, dtype) is None)
    found = kernels(backend) if isinstance(backend, str) else backend
    reason = why_unavailable(found, dtype)
    if reason is not None:
        raise ValueError(f"backend {found.name!r} is not available: {reason}")
    return found


def why_unavailable(backend: str | Kernels, dtype: DTypeLike = jnp.float32) -> str | None:
    """Returns the reason why a backend cannot compute in `dtype` on this machine, or None if it can."""
    found = kernels(backend) if isinstance(backend, str) else backend
    name = jnp.dtype(dtype).name
    if name not in found.dtypes:
        return f"it computes in {' or '.join(found.dtypes)}, not in {name}"
    return found.why_unavailable()


def kernels(name: str) -> Kernels:
    """Returns the kernels of the backend of this name, whether or not they can run here.

    Raises:
        ValueError: if there is no such backend.
    """
    if name not in BACKENDS:
        raise ValueError(f"no backend {name!r}: choose from {', '.join([AUTO, *BACKENDS])}")
    module, attribute = BACKENDS[name].split(":")
    return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
