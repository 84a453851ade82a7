"""This machine: what it runs, how much memory was used, where compiled programs are kept."""

import ctypes
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import jax

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
PACKAGES = ("splatax", "jax", "jaxlib", "numpy", "optax", "pycolmap")


def keep_compiled_programs() -> None:
    """Lets JAX find the programs of earlier runs instead of compiling them again.

    They are kept in the user's cache folder, unless JAX has been told another place.
    """
    if jax.config.values["jax_compilation_cache_dir"] is None:
        root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(root) / "splatax" / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def keep_freed_memory() -> None:
    """Lets glibc keep large blocks that are freed: the next step wants them again, and fresh pages cost
    a tenth of a step's time. Other systems are left alone."""
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):
            libc.mallopt(M_MMAP_THRESHOLD, 2**30)
            libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def peak_memory() -> int | None:
    """Most memory that this process has held, bytes; None where the system does not tell."""
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else used * 1024


def physical_memory() -> int | None:
    """Of this machine, bytes; None where the system does not tell."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf
        return None


def versions() -> dict[str, str]:
    """Of what decides a result."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def device() -> str:
    """What JAX runs on here, in words."""
    kind = jax.devices()[0].device_kind
    if jax.default_backend() == "cpu":
        return f"{cpu_name()}, {os.cpu_count()} threads"
    return f"{len(jax.devices())} x {kind}"


def cpu_name() -> str:
    """The processor's own name where the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
