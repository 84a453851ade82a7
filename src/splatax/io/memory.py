"""How much memory the machine has."""

import os
from functools import lru_cache
from pathlib import Path

CONTAINER = Path("/sys/fs/cgroup/memory.max")  # Linux, version 2
ASSUMED = 8 << 30  # bytes, where the system does not tell


@lru_cache
def machine_memory() -> int:
    """Returns the bytes of memory of the machine, or of the container if that may have less."""
    try:
        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        machine = ASSUMED
    try:
        return min(machine, int(CONTAINER.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        return machine
