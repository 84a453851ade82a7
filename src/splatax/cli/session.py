"""One run as the command line makes it: training, watched."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import splatax as sx
from splatax.budget import Changes
from splatax.cli.checkpoints import Checkpoints, files
from splatax.cli.display import Display
from splatax.cli.failures import sentence
from splatax.cli.interruption import Interruption
from splatax.cli.output import complain
from splatax.cli.view import Audience
from splatax.errors import InputError
from splatax.evaluation import picture
from splatax.report.history import Evaluation, History
from splatax.report.pictures import shrunk
from splatax.runs.claim import claimed
from splatax.training.loop import RunState

FRAMES = 20  # of the animation, close together at first, when most happens


@contextmanager
def claim(out: Path, overwrite: bool) -> Iterator[None]:
    """Holds the folder of a run for this process, and makes it if need be, before any work is done for it.

    Raises:
        InputError: if it holds results that must not be replaced, another process writes to it, or it cannot
            be written to.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: a file, not a folder. Choose another --out.")
    with claimed(out):
        if files(out) and not overwrite:
            raise InputError(
                f"{out}: holds a run that was stopped. Go on with it: splatax train --resume {out}, choose "
                "another --out, or replace it: --overwrite."
            )
        if (out / "scene.ply").exists() and not overwrite:
            raise InputError(
                f"{out}: holds the results of a run. Choose another --out, or replace it: --overwrite."
            )
        yield


class Stopwatch:
    """Seconds of training: those spent on looking do not count."""

    def __init__(self, before: float):
        """Starts.

        Args:
            before: seconds that count already.
        """
        self._began = time.monotonic() - before

    @property
    def seconds(self) -> float:
        """That count until now."""
        return time.monotonic() - self._began

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """While one looks."""
        before = self.seconds
        yield
        self._began = time.monotonic() - before


@dataclass(frozen=True)
class Session:
    """Training with a progress bar, evaluations, pictures of one view and checkpoints.

    Attributes:
        dataset: the capture.
        recipe: how.
        checkpoints: where the run is saved now and then, and when it is interrupted.
        history: of the run until now; it grows.
        changes: of the number of steps.
        eval_every: steps between evaluations of the test views; 0 for none.
        audience: who may look on; None for nobody.
        photo_room: bytes of memory for decoded photos.
        interruption: how the user may ask for an early end.
    """

    dataset: sx.Dataset
    recipe: sx.Recipe
    checkpoints: Checkpoints
    history: History
    changes: Changes
    eval_every: int = 0
    audience: Audience | None = None
    photo_room: int | float = math.inf
    interruption: Interruption = field(default_factory=Interruption)

    def train(self, start: RunState | None = None) -> RunState:
        """Trains, saves the last state, and returns it.

        Ctrl-C ends training after the step at hand, with what has been reached. A run whose steps are all
        made already is returned as it is.

        Args:
            start: the run to go on with.
        """
        state = start if start and all_made(start) else self._steps(start)
        faults = state.train.faults
        self.history.bad_steps, self.history.broken = int(faults.steps), int(faults.gaussians)
        return state

    def _steps(self, start: RunState | None) -> RunState:
        history = self.history
        with Display(self.recipe.steps) as display, self.interruption:
            display.announce("compiling the first step")
            watch = Stopwatch(history.train_seconds)
            for progress in sx.optimize(self.dataset, self.recipe, start, self.changes, self.photo_room):
                history.losses.append(progress.loss)
                history.counts.append(progress.count)
                history.interrupted = self.interruption.requested and progress.step < progress.total
                display.steps, display.psnr = progress.total, history.psnr
                display.step(progress.step, progress.loss, progress.count)
                if wanted := list(self.wanted(progress)):
                    progress.loss.block_until_ready()
                    history.train_seconds = watch.seconds
                    with watch.stopped():
                        for look in wanted:
                            look(progress)
                if history.interrupted:
                    break
            progress.loss.block_until_ready()
            history.train_seconds = watch.seconds
        if not history.interrupted:
            self._keep(progress.state)
        return progress.state

    def _keep(self, state: RunState) -> None:
        """Saves the end of training, so that nothing which happens to the results can lose it."""
        try:
            self.checkpoints.save(state, self.history)
            self.checkpoints.wait()
        except (InputError, MemoryError) as error:
            # Try on: a disk that is full may still have room for the scene, which is smaller.
            cause = error.__cause__
            why = sentence(cause) if isinstance(cause, OSError) else str(error)
            complain(f"the end of training cannot be saved before its results are written: {why}")

    def wanted(self, progress: sx.Progress) -> Iterator[Callable[[sx.Progress], None]]:
        """What is to be done after a step, once it has ended."""
        step, total = progress.step, progress.total
        if self.changes.due(step, total):
            yield self.note_the_time
        if step in frames(total):
            yield self.take_picture
        if step < total:
            if self.eval_every and step % self.eval_every == 0 and self.dataset.test:
                yield self.evaluate
            if self.checkpoints.due(step) or self.history.interrupted:
                yield self.save
        if self.audience and self.audience.waits:
            yield self.show

    def note_the_time(self, progress: sx.Progress) -> None:
        """The number of steps may change by it."""
        self.changes.note(progress.step, progress.total, self.history.train_seconds)

    def take_picture(self, progress: sx.Progress) -> None:
        """Of the first test view, for the animation."""
        image = picture(
            progress.padded,
            (self.dataset.test or self.dataset.train)[0].camera,
            background=self.recipe.background.rgb,
            low_pass=self.recipe.low_pass,
            backend=self.recipe.backend,
        )
        label = f"step {progress.step:,}   {progress.count:,} Gaussians"
        self.history.frames.append((label, shrunk(image)))

    def evaluate(self, progress: sx.Progress) -> None:
        """The test views."""
        scores = sx.evaluate(
            progress.padded,
            self.dataset.test,
            background=self.recipe.background.rgb,
            low_pass=self.recipe.low_pass,
            backend=self.recipe.backend,
        )
        self.history.evaluations.append(Evaluation(progress.step, self.history.train_seconds, scores))

    def save(self, progress: sx.Progress) -> None:
        """A checkpoint."""
        self.checkpoints.save(progress.state, self.history)

    def show(self, progress: sx.Progress) -> None:
        """The scene, to those who look on."""
        assert self.audience
        self.audience.show(progress, self.history, lambda: self.interruption.requested)


def all_made(state: RunState) -> bool:
    """Returns whether no step is left to do, so that only the results of the run may be missing."""
    return int(state.train.step) >= int(state.train.total)


@cache
def frames(total: int) -> set[int]:
    """Steps that have a picture in the animation."""
    return {max(round(total * (i / (FRAMES - 1)) ** 2), 1) for i in range(FRAMES)}
