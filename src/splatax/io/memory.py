"""Memory size of the machine or container, and the part of it that decoding photos may take."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from threading import Condition

CONTAINER = Path("/sys/fs/cgroup/memory.max")  # Linux, version 2
ASSUMED = 8 << 30  # bytes, if the system does not report its memory
MEMORY_DIVISOR = 4  # photos being decoded, or the volume of a mesh, may take the memory divided by this


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


class Allowance:
    """Memory that several threads share: a thread waits until there is enough for its work.

    Work that needs more than all of it runs alone, so nothing waits forever.
    """

    def __init__(self, limit: int | None = None):
        """Creates an allowance of so many bytes; None for a fixed part of the machine's memory."""
        self._limit, self._taken = limit, 0
        self._changed = Condition()

    @property
    def limit(self) -> int:
        """Bytes of all work at one time."""
        return machine_memory() // MEMORY_DIVISOR if self._limit is None else self._limit

    @limit.setter
    def limit(self, limit: int | None) -> None:
        with self._changed:
            self._limit = limit
            self._changed.notify_all()

    @contextmanager
    def taken(self, size: int) -> Iterator[None]:
        """Waits until so many bytes are left, and takes them for the work inside."""
        with self._changed:
            self._changed.wait_for(lambda: not self._taken or self._taken + size <= self.limit)
            self._taken += size
        try:
            yield
        finally:
            with self._changed:
                self._taken -= size
                self._changed.notify_all()


decoding = Allowance()  # of the process, for the photos that its threads decode
