"""Facts about this machine and process: device, memory, versions of packages."""

import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import jax

import splatax

PACKAGES = ("jax", "jaxlib", "numpy", "optax", "pycolmap")
DECISIVE = ("splatax", "jax", "jaxlib", "numpy", "optax")  # packages whose version decides what a step does


def peak_memory() -> int | None:
    """Returns the most memory that this process has held, in bytes; None where the system does not tell."""
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else used * 1024


def physical_memory() -> int | None:
    """Returns the memory of this machine in bytes; None where the system does not tell."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf
        return None


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that decide a result."""
    own = {"python": platform.python_version(), "splatax": splatax.__version__}  # of the code that runs
    return own | {name: version(name) for name in PACKAGES}


def device() -> str:
    """Returns the name of the device that JAX runs on."""
    kind = jax.devices()[0].device_kind
    if jax.default_backend() == "cpu":
        return f"{cpu_name()}, {os.cpu_count()} threads"
    return f"{len(jax.devices())} x {kind}"


def processor() -> str:
    """Returns the name of the processor whose roundings decide a result: a device, or the CPU."""
    return cpu_name() if jax.default_backend() == "cpu" else str(jax.devices()[0].device_kind)


def cpu_name() -> str:
    """Returns the processor's own name where the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def busyness() -> float:
    """Returns the factor by which other programs slow down work, from the load of the last minute.

    It is 1 on a machine with a core for each program that runs, and where the system does not tell the load.
    """
    try:
        return max(os.getloadavg()[0] / (os.cpu_count() or 1), 1.0)
    except (AttributeError, OSError):
        return 1.0
