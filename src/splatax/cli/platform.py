"""Settings of JAX and of the C library that suit commands: whole processes that train."""

import ctypes
import os
import sys
from pathlib import Path

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h


def keep_compiled_programs() -> None:
    """Lets JAX find the programs of earlier runs instead of compiling them again.

    They are kept in the user's cache folder, unless JAX is configured with another folder.
    """
    import jax  # which takes a second: a list of commands does without

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
