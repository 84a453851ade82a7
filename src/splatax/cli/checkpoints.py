"""The checkpoints of a run: when they are due, a thread that writes them, and those that are kept."""

import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from splatax.errors import InputError
from splatax.evaluation import Scores, ViewScore
from splatax.io.files import disk_of, replacing
from splatax.report.history import Evaluation, History
from splatax.training import checkpoint
from splatax.training.checkpoint import Checkpoint
from splatax.training.loop import RunState

FOLDER = "checkpoints"  # in that of the run


class Checkpoints:
    """Saves a run while it goes on, one file at a time, and keeps the last two.

    A context: leaving it waits for the file that is being written, unless the user stops at once.
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
        """Makes room for new ones.

        Args:
            run: folder of the run.
            facts: of the run, kept in the header.
            seconds: between checkpoints; 0 for none by the clock.
            steps: between checkpoints; 0 for none by count.
            earlier: the one that the run goes on from. Without it, those of an earlier run are removed.
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
        """Whether to save after this step.

        Raises:
            InputError: if the last one could not be written.
        """
        writing = self._thread is not None and self._thread.is_alive()
        if not writing:
            self.wait()
        waited = self.seconds and not writing and time.monotonic() - self._saved >= self.seconds
        return bool(waited or (self.steps and step % self.steps == 0))

    def save(self, state: RunState, history: History) -> None:
        """Copies the run and starts to write it, after the one before.

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
        """Until all is written.

        Raises:
            InputError: if it could not be.
        """
        if self._thread:
            self._thread.join()
            self._thread = None
        if self._error:
            error, self._error = self._error, None
            if not isinstance(error, OSError):
                raise error
            way_out = (
                f"Help that, and go on from {self._latest.name}: splatax train --resume {self.run}"
                if self._latest
                else "Do without checkpoints: --checkpoint-every 0"
            )
            raise InputError(
                f"{self.run / FOLDER}: no checkpoint can be written ({error.strerror or error}; "
                f"{disk_of(self.run)}), so training has stopped. {way_out}."
            ) from error

    def discard(self) -> None:
        """Removes all: the run has ended."""
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
        except Exception as error:  # told by the thread that trains
            self._error = error


def files(run: Path) -> list[Path]:
    """Checkpoints in the folder of a run, the oldest first."""
    return sorted((run / FOLDER).glob("[0-9]*.npz"))


def packed(history: History) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A history as JSON values and arrays. Its losses are plain numbers from then on."""
    history.losses[:] = [float(loss) for loss in history.losses]
    arrays: dict[str, np.ndarray] = {
        "history/losses": np.array(history.losses, np.float32),
        "history/counts": np.array(history.counts, np.int64),
    }
    arrays |= {f"history/frame{i}": picture for i, (_, picture) in enumerate(history.frames)}
    header: dict[str, Any] = {
        "seconds": history.train_seconds,
        "evaluations": [asdict(evaluation) for evaluation in history.evaluations],
        "frames": [label for label, _ in history.frames],
        "changes": history.changes,
    }
    return header, arrays


def unpacked(saved: Checkpoint) -> History:
    """The history that was packed."""
    header, arrays = saved.header, saved.arrays
    return History(
        losses=arrays["history/losses"].tolist(),
        counts=arrays["history/counts"].tolist(),
        evaluations=[
            Evaluation(e["step"], e["seconds"], Scores(tuple(ViewScore(**v) for v in e["scores"]["views"])))
            for e in header["evaluations"]
        ],
        frames=[(label, arrays[f"history/frame{i}"]) for i, label in enumerate(header["frames"])],
        train_seconds=header["seconds"],
        changes=[(step, total) for step, total in header["changes"]],
    )
