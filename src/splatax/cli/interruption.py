"""Ctrl-C, made safe: work ends between two steps, where nothing is half done."""

import signal
from types import FrameType
from typing import Any


class Interruption:
    """While this context is open, the first Ctrl-C only asks to stop; the second one stops at once.

    Attributes:
        requested: whether the user has asked to stop.
    """

    def __init__(self) -> None:
        self.requested = False
        self._earlier: Any = None

    def __enter__(self) -> "Interruption":
        self._earlier = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._earlier)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
