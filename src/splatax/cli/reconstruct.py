"""`splatax reconstruct`: from photos to a capture."""

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from splatax.cli.display import PLAIN_SECONDS
from splatax.cli.interruption import resumable
from splatax.cli.output import say
from splatax.errors import InputError
from splatax.reconstruction import Outcome, pipeline, reconstruct
from splatax.reconstruction.mapping import Features
from splatax.reconstruction.pairs import Exhaustive, Pairing, Sequential, Similar
from splatax.reconstruction.work import clear
from splatax.runs.budget import duration
from splatax.runs.claim import claimed

PAIRINGS: dict[str, Pairing | None] = {
    "auto": None,
    "exhaustive": Exhaustive(),
    "similar": Similar(),
    "sequential": Sequential(),
}
DETAILS: dict[str, Features | None] = {
    "auto": None,
    "normal": Features(),
    "high": Features(longest_side=2400, most=16_384, first_octave=-1),
}
PairingName = Literal[*PAIRINGS]  # type: ignore[valid-type]
DetailName = Literal[*DETAILS]  # type: ignore[valid-type]
NAMED = 5  # photos of one reason that are named


@dataclass(frozen=True)
class Reconstruct:
    """Find out where photos were taken, and write a capture to train on.

    Structure from motion by COLMAP, on the CPU. Writes undistorted photos to OUT/images and the model to
    OUT/sparse/0. Run again after Ctrl-C or a crash, it goes on where it was.
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos, or a video."""
    out: Path
    """Folder for the capture."""
    frames: int = 200
    """How many frames to take of a video: the sharpest of each stretch."""
    matching: PairingName = "auto"
    """Which pairs of photos to match: all, those that look alike, or those that follow each other.
    "auto": all of up to 80 photos, those alike of more, those that follow each other of a video."""
    detail: DetailName = "auto"
    """"high" looks for features four times as long, where "normal" finds too few. "auto": "normal", and
    smaller features too of up to 30 photos."""
    seed: int = 0
    """Of all randomness."""
    overwrite: bool = False
    """Replace what an earlier call has written to the same folder."""

    def run(self) -> None:
        if self.frames < pipeline.FEWEST:
            raise InputError(f"--frames: at least {pipeline.FEWEST}, not {self.frames}.")
        began = time.monotonic()
        with claimed(self.out), resumable(), Stages() as stages:
            if self.overwrite:
                clear(self.photos, self.out)
            outcome = reconstruct(
                self.photos,
                self.out,
                frames=self.frames,
                features=DETAILS[self.detail],
                pairing=PAIRINGS[self.matching],
                seed=self.seed,
                watch=stages.show,
            )
        for line in told(outcome):
            say(line)
        say(f"capture {self.out}, after {duration(time.monotonic() - began)}")
        say(f"look at it: splatax inspect {self.out}      train on it: splatax train {self.out}")


def told(outcome: Outcome) -> list[str]:
    """What became of the photos, in words."""
    count = len(outcome.registered)
    lines = [
        f"{count} of {count + len(outcome.rejected)} photos registered",
        f"{outcome.points:,} points, mean reprojection error {outcome.error:.2f} px",
    ]
    for reason, number in Counter(outcome.rejected.values()).most_common():
        names = [name for name, why in outcome.rejected.items() if why == reason]
        more = f" and {number - NAMED} more" if number > NAMED else ""
        lines.append(f"not registered: {', '.join(names[:NAMED])}{more}: {reason}")
    return lines


class Stages:
    """How far each stage is: bars on a terminal, lines elsewhere. A context manager."""

    def __init__(self, console: Console | None = None):
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

    def show(self, stage: str, done: int, total: int) -> None:
        """Shows a stage; on a terminal with the time that it still takes."""
        new = stage not in self._tasks
        if new:
            number = pipeline.STAGES.index(stage) + 1
            label = f"{number}/{len(pipeline.STAGES)} {stage}"
            self._tasks[stage] = self._bars.add_task(label, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)  # type: ignore[arg-type]
        if self.console.is_terminal:
            return
        if new or time.monotonic() - self._printed > PLAIN_SECONDS:
            self._printed = time.monotonic()
            self.console.print(f"{stage}: {done:,} of {total:,}")
