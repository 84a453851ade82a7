"""The functions through which commands print. They escape control characters, and a full disk or a closed
pipe behind standard output does not end the work."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

from rich.console import Console
from rich.text import Text

from splatax.errors import is_shown

UNWRITTEN = 1  # exit code where standard output could not be written, as of other command-line tools


def printable(text: str) -> str:
    """Returns text with its control characters escaped, so that a file name cannot command the terminal."""
    return "".join(character if is_shown(character) else _escaped(character) for character in text)


def say(text: object) -> None:
    """Prints a line."""
    print(printable(str(text)), flush=True)


def complain(text: object) -> None:
    """Prints a line on standard error, after the name of the program."""
    print(f"splatax: {printable(str(text))}", file=sys.stderr, flush=True)


def cell(text: object, style: str = "") -> Text:
    """Returns text for a table, free of control characters and of markup."""
    return Text(printable(str(text)), style=style)


def show(renderable: Any) -> None:
    """Prints a table, or markup that holds no names."""
    Console().print(renderable)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()


class Output:
    """Standard output whose errors do not end the command.

    The first write that fails is reported on standard error, unless a reader such as `head` has closed the
    pipe. Everything after it is discarded, and the command continues.

    Attributes:
        failed: whether output was lost for another reason than a closed pipe.
    """

    def __init__(self, stream: Any):
        self._stream = stream
        self.failed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Writes, or discards."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._discard(error)
            return len(text)

    def flush(self) -> None:
        """Passes on what is buffered, or discards it."""
        try:
            self._stream.flush()
        except OSError as error:
            self._discard(error)

    def _discard(self, error: OSError) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())  # what is still buffered goes there too
        os.close(nowhere)
        if not isinstance(error, BrokenPipeError):
            self.failed = True
            complain(f"standard output: {error.strerror}. The command continues without it.")


@contextmanager
def guarded() -> Iterator[None]:
    """Lets the work inside continue if standard output fails.

    Exits with `UNWRITTEN` at the end if output was lost, unless the work fails by itself.
    """
    if sys.stdout is None:  # closed by the caller
        yield
        return
    output = Output(sys.stdout)
    with redirect_stdout(output):
        try:
            yield
        except SystemExit as end:
            output.flush()
            if end.code or not output.failed:
                raise
        finally:
            output.flush()
    if output.failed:
        sys.exit(UNWRITTEN)
