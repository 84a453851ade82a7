"""Signals that end training safely: after the current step, when its state is complete."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from splatax.cli.output import complain

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and what a system sends before it shuts down
STOPPED = 130  # exit code, as shells have it for Ctrl-C


@contextmanager
def resumable() -> Iterator[None]:
    """Prints that the same command continues the work inside, if the user stops it."""
    try:
        yield
    except KeyboardInterrupt:
        complain("stopped. Run the same command again to resume")
        sys.exit(STOPPED)


class Interruption:
    """A context manager in which the first signal only asks to stop, and the second one stops at once.

    Attributes:
        requested: whether a signal has asked to stop.
    """

    def __init__(self) -> None:
        self.requested = False
        self._earlier: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "Interruption":
        self._earlier = {number: signal.signal(number, self._ask) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
