"""The checkpoints of a run: when they are due, the thread that writes them, and which are kept."""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from splatax.errors import InputError
from splatax.io.files import disk_of, replacing
from splatax.runs.history import History, packed
from splatax.training import checkpoint
from splatax.training.checkpoint import Checkpoint, Stoppable

FOLDER = "checkpoints"  # in that of the run


class Checkpoints:
    """Saves a run while it continues, one file at a time, and keeps the last two.

    A context manager: leaving it waits for the file that is being written, unless the user stops at once.
    """

    def __init__(
        self,
        run: Path,
        facts: Mapping[str, Any],
        *,
        seconds: float = 0.0,
        steps: int = 0,
        earlier: Path | None = None,
    ):
        """Removes files that are in the way of new checkpoints.

        Args:
            run: folder of the run.
            facts: about the run, kept in the header; see `resume.facts`.
            seconds: between checkpoints; 0 for none by the clock.
            steps: between checkpoints; 0 for none by count.
            earlier: the checkpoint that is resumed. Without it, those of an earlier run are removed.
        """
        self.run, self.facts, self.seconds, self.steps = run, facts, seconds, steps
        self._latest = earlier
        self._saved = time.monotonic()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None
        remains = [] if earlier else files(run)
        for path in [*remains, *(run / FOLDER).glob(".*.tmp")]:
            path.unlink()

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.wait()
        elif self._thread and not isinstance(error, KeyboardInterrupt):
            self._thread.join()

    def due(self, step: int) -> bool:
        """Returns whether to save after this step.

        Raises:
            InputError: if the last one could not be written.
        """
        writing = self._thread is not None and self._thread.is_alive()
        if not writing:
            self.wait()
        waited = self.seconds and not writing and time.monotonic() - self._saved >= self.seconds
        return bool(waited or (self.steps and step % self.steps == 0))

    def save(self, state: Stoppable, history: History) -> None:
        """Copies the run and starts to write it, once the checkpoint before is written.

        Raises:
            InputError: if the one before could not be written.
        """
        self.wait()
        header, arrays = packed(history)
        copy = checkpoint.take(state, {"run": self.facts, **header}, arrays)
        self._thread = threading.Thread(target=self._write, args=(copy,), daemon=True)
        self._thread.start()
        self._saved = time.monotonic()

    def wait(self) -> None:
        """Waits until everything is written.

        Raises:
            InputError: if it could not be written.
        """
        if self._thread:
            self._thread.join()
            self._thread = None
        if self._error:
            error, self._error = self._error, None
            if not isinstance(error, OSError):
                raise error
            if self._latest:
                way_out = f"Help that, and resume from {self._latest.name}"
                options = (f"resume {self.run}",)
            else:
                way_out, options = "Help that, or train without checkpoints", ("checkpoint_every 0",)
            raise InputError(
                f"{self.run / FOLDER}: no checkpoint can be written ({error.strerror or error}; "
                f"{disk_of(self.run)}), so training has stopped. {way_out}.",
                options=options,
            ) from error

    def discard(self) -> None:
        """Removes all checkpoints: the run has ended."""
        self.wait()
        for path in files(self.run):
            path.unlink()
        if (self.run / FOLDER).is_dir():
            (self.run / FOLDER).rmdir()

    def _write(self, copy: Checkpoint) -> None:
        path = self.run / FOLDER / f"{copy.step:08}.npz"
        try:
            path.parent.mkdir(exist_ok=True)
            with replacing(path) as file:
                checkpoint.write(file, copy)
            for other in files(self.run):
                if other not in (path, self._latest):
                    other.unlink()
            self._latest = path
        except Exception as error:  # reported by the thread that trains
            self._error = error


@dataclass(frozen=True)
class NoCheckpoints:
    """The checkpoints of a process that does not keep them: it only knows after which steps others save.

    Attributes:
        steps: between checkpoints; 0 for none.
    """

    steps: int = 0

    def due(self, step: int) -> bool:
        """Returns whether another process saves after this step."""
        return bool(self.steps and step % self.steps == 0)

    def save(self, state: Stoppable, history: History) -> None:
        """Keeps nothing."""

    def wait(self) -> None:
        """Returns at once."""


def files(run: Path) -> list[Path]:
    """Returns the checkpoints in the folder of a run, the oldest first."""
    return sorted((run / FOLDER).glob("[0-9]*.npz"))
