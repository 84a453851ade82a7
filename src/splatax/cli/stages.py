"""The progress of work in stages: bars on a terminal, lines elsewhere."""

import time
from collections.abc import Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from splatax.cli.display import PLAIN_SECONDS


class Stages:
    """Progress of the stages: bars on a terminal, lines elsewhere. A context manager."""

    def __init__(self, names: Sequence[str], console: Console | None = None):
        """Starts with no stage.

        Args:
            names: of all stages, in order.
            console: to print on.
        """
        self.names = names
        self.console = console or Console()
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=self.console,
            disable=not self.console.is_terminal,
            expand=True,
        )
        self._tasks: dict[str, object] = {}
        self._printed = 0.0

    def __enter__(self) -> "Stages":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def note(self, text: str) -> None:
        """Prints a line above the bars."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(self, stage: str, done: int, total: int) -> None:
        """Shows the progress of a stage; on a terminal with the remaining time."""
        new = stage not in self._tasks
        if new:
            label = f"{self.names.index(stage) + 1}/{len(self.names)} {stage}"
            self._tasks[stage] = self._bars.add_task(label, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)  # type: ignore[arg-type]
        if self.console.is_terminal:
            return
        if new or time.monotonic() - self._printed > PLAIN_SECONDS:
            self._printed = time.monotonic()
            self.console.print(f"{stage}: {done:,} of {total:,}")
