"""The backends that the contract suites run on: the registry, and the emulation of the CUDA backend."""

import pytest

import emulated
from splatax import backends
from splatax.backends.protocol import Kernels

# "cpu" is the best of its builds, each of which has its own name.
NAMES = [*(name for name in backends.BACKENDS if name != "cpu"), emulated.NAME]


def available(name: str) -> str | Kernels:
    """What to pass as `backend`; the test is skipped where this machine cannot run it."""
    reason = emulated.why_unavailable() if name == emulated.NAME else backends.why_unavailable(name)
    if reason is not None:
        pytest.skip(reason)
    return emulated.kernels() if name == emulated.NAME else name


def kernels(name: str) -> Kernels:
    """The kernels of a backend that is available."""
    found = available(name)
    return found if isinstance(found, Kernels) else backends.kernels(found)
