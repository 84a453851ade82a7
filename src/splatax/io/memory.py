"""Memory size of the machine or container."""

import os
from functools import lru_cache
from pathlib import Path

CONTAINER = Path("/sys/fs/cgroup/memory.max")  # Linux, version 2
ASSUMED = 8 << 30  # bytes, if the system does not report its memory


@lru_cache
def machine_memory() -> int:
    """Returns the memory of the machine in bytes, or the limit of the container if that is lower."""
    try:
        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        machine = ASSUMED
    try:
        return min(machine, int(CONTAINER.read_text()))
    except (OSError, ValueError):  # not in a container, or in one without a limit
        return machine
