"""Being asked to stop, made safe: work ends between two steps, where nothing is half done."""

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
    """Around work that the same command goes on with: says so when it is stopped."""
    try:
        yield
    except KeyboardInterrupt:
        complain("stopped. To go on: the same command again")
        sys.exit(STOPPED)


class Interruption:
    """While this context is open, the first signal only asks to stop; the second one stops at once.

    Attributes:
        requested: whether someone has asked to stop.
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
