"""The progress of training on the terminal."""

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn

from splatax.runs.budget import duration

PLAIN_SECONDS = 10  # between lines where there is no terminal
REFRESH_SECONDS = 0.25  # between updates of the bar
SPEED_STEPS = 50  # that the speed is averaged over


class Display:
    """A progress bar on a terminal, and a line every few seconds elsewhere. A context manager."""

    def __init__(self, steps: int, console: Console | None = None):
        self.steps = steps
        self.console = console or Console()
        self.psnr: float | None = None
        self._times: list[tuple[int, float]] = []  # from the end of the first step, which compiles
        self._shown = 0.0
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[state]}"),
            console=self.console,
            disable=not self.console.is_terminal,
            expand=True,
        )
        self._task = self._bar.add_task("starting", total=steps, state="")

    def __enter__(self) -> "Display":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def announce(self, activity: str) -> None:
        """Shows what is done before the first step."""
        if self.console.is_terminal:
            self._bar.update(self._task, description=activity)
            self._bar.refresh()
        else:
            self.console.print(f"{activity} ...")

    def step(self, step: int, loss: object, count: int) -> None:
        """Shows a step. The loss is read, which waits for the device, only when it is shown."""
        now = time.monotonic()
        self._times = [*self._times[-SPEED_STEPS:], (step, now)]
        interval = REFRESH_SECONDS if self.console.is_terminal else PLAIN_SECONDS
        if now - self._shown < interval and step < self.steps:
            return
        self._shown = now
        state = self._state(step, float(loss), count)  # type: ignore[arg-type]
        if self.console.is_terminal:
            self._bar.update(
                self._task, completed=step, total=self.steps, description="training", state=state
            )
        else:
            self.console.print(f"step {step:,} of {self.steps:,}  {state}", soft_wrap=True)

    def _state(self, step: int, loss: float, count: int) -> str:
        parts = [f"loss {loss:.4f}", f"{count:,} Gaussians"]
        if self.psnr is not None:
            parts.append(f"test {self.psnr:.2f} dB")
        (first_step, first_time), (last_step, last_time) = self._times[0], self._times[-1]
        if last_step > first_step:
            speed = (last_step - first_step) / max(last_time - first_time, 1e-9)
            parts.append(f"{speed:.1f} steps/s  ETA {duration((self.steps - step) / speed)}")
        return "  ".join(parts)
