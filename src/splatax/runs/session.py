"""Training as a run: watched by the clock, evaluated, pictured and saved on the way."""

import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache

import jax

from splatax.dataset import Dataset
from splatax.errors import DatasetError, InputError
from splatax.evaluation import evaluate, picture
from splatax.io.files import explained
from splatax.runs.checkpoints import Checkpoints, NoCheckpoints
from splatax.runs.clock import Changes
from splatax.runs.history import Evaluation, History, shrunk
from splatax.training.loop import Progress, RunState, optimize
from splatax.training.recipes import Recipe

FRAMES = 20  # of the animation, close together at first, when most happens


class Stopwatch:
    """Counts seconds of training: those spent on other work do not count."""

    def __init__(self, before: float):
        """Starts.

        Args:
            before: seconds that count already.
        """
        self._began = time.monotonic() - before

    @property
    def seconds(self) -> float:
        """Seconds of training until now."""
        return time.monotonic() - self._began

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Does not count the time that is spent inside."""
        before = self.seconds
        yield
        self._began = time.monotonic() - before


@dataclass
class Session:
    """One run while it is trained. A progress bar or a viewer is a `for` loop over its `steps`.

    Attributes:
        dataset: the capture.
        recipe: all settings of the training.
        checkpoints: where the run is saved now and then, when it is interrupted, and at its end.
        history: the record of the run until now; it grows.
        changes: of the number of steps.
        eval_every: steps between evaluations of the held-out views; 0 for none.
        photo_room: bytes of memory for decoded photos.
        stop_requested: asked after each step; if true, the run is saved and ends.
        last: the run after its last step, once there is one.
    """

    dataset: Dataset
    recipe: Recipe
    checkpoints: Checkpoints | NoCheckpoints
    history: History = field(default_factory=History)
    changes: Changes = field(default_factory=Changes)
    eval_every: int = 0
    photo_room: int | float = math.inf
    stop_requested: Callable[[], bool] = lambda: False
    last: RunState | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._watch = Stopwatch(self.history.train_seconds)

    def steps(self, start: RunState | None = None) -> Iterator[Progress]:
        """Trains, and yields after each step, once the evaluation, picture and checkpoint due then are made.

        The run is saved once more after its last step. A run whose steps are all made yields nothing.

        Args:
            start: the run to continue.
        """
        if start is not None and all_made(start):
            self._end(start)
            return
        history = self.history
        self._watch = Stopwatch(history.train_seconds)
        for progress in self._saved_if_a_photo_fails(start):
            history.losses.append(progress.loss)
            history.counts.append(progress.count)
            history.interrupted = self.stop_requested() and progress.step < progress.total
            if due := list(self._due(progress)):
                with self.paused(progress):
                    for work in due:
                        work(progress)
            yield progress
            if history.interrupted:
                break
        progress.loss.block_until_ready()
        history.train_seconds = self._watch.seconds
        if not history.interrupted:
            self._keep(progress.state)
        self._end(progress.state)

    def _saved_if_a_photo_fails(self, start: RunState | None) -> Iterator[Progress]:
        """Yields the steps of the run. If a photo can no longer be read, saves the steps until then."""
        last = None
        try:
            for last in optimize(self.dataset, self.recipe, start, self.changes, self.photo_room):
                yield last
        except DatasetError as error:
            if last is None or not isinstance(self.checkpoints, Checkpoints) or jax.process_count() > 1:
                raise
            with self.paused(last):
                self._save(last)
                self.checkpoints.wait()
            raise DatasetError(
                f"{error} The run is saved after step {last.step:,}. Resume it once that is fixed.",
                options=(f"resume {self.checkpoints.run}",),
            ) from error

    @contextmanager
    def paused(self, progress: Progress) -> Iterator[None]:
        """Waits for the step to end. What is done inside does not count as time of training."""
        progress.loss.block_until_ready()
        self.history.train_seconds = self._watch.seconds
        with self._watch.stopped():
            yield

    def _due(self, progress: Progress) -> Iterator[Callable[[Progress], None]]:
        """Yields the work to do after a step, once it has ended."""
        step, total = progress.step, progress.total
        if self.changes.due(step, total):
            yield self._note_the_time
        if step in frames(total):
            yield self._take_picture
        if step < total:
            if self.eval_every and step % self.eval_every == 0 and self.dataset.test:
                yield self._evaluate
            if self.checkpoints.due(step) or self.history.interrupted:
                yield self._save

    def _note_the_time(self, progress: Progress) -> None:
        self.changes.note(progress.step, progress.total, self.history.train_seconds)

    def _take_picture(self, progress: Progress) -> None:
        image = picture(
            self.dataset.in_context(progress.padded),
            (self.dataset.test or self.dataset.train)[0].camera,
            self.recipe.renderer,
        )
        label = f"step {progress.step:,}   {progress.count:,} Gaussians"
        self.history.frames.append((label, shrunk(image)))

    def _evaluate(self, progress: Progress) -> None:
        scene = self.dataset.in_context(progress.padded)
        scores = evaluate(scene, self.dataset.test, renderer=self.recipe.renderer)
        self.history.evaluations.append(Evaluation(progress.step, self.history.train_seconds, scores))

    def _save(self, progress: Progress) -> None:
        self.checkpoints.save(progress.state, self.history)

    def _keep(self, state: RunState) -> None:
        """Saves the end of training, so that nothing which happens to the results can lose it."""
        try:
            self.checkpoints.save(state, self.history)
            self.checkpoints.wait()
        except (InputError, MemoryError) as error:
            # Go on: a disk that is full may still have room for the scene, which is smaller.
            cause = error.__cause__
            why = explained(cause) if isinstance(cause, OSError) else str(error)
            warnings.warn(
                f"the end of training cannot be saved before its results are written: {why}", stacklevel=1
            )

    def _end(self, state: RunState) -> None:
        faults = state.train.faults
        self.history.bad_steps, self.history.broken = int(faults.steps), int(faults.gaussians)
        self.last = state


class WorkerSession(Session):
    """A run in a process that makes the steps with others, and leaves evaluation and pictures to process 0.

    Process 0 gathers the scene for them from the devices of all processes, which therefore all take part.
    """

    def _take_picture(self, progress: Progress) -> None:
        _ = progress.padded

    def _evaluate(self, progress: Progress) -> None:
        _ = progress.padded


def all_made(state: RunState) -> bool:
    """Returns whether no step is left to do, so that only the results of the run may be missing."""
    return int(state.train.step) >= int(state.train.total)


@cache
def frames(total: int) -> set[int]:
    """Returns the steps that have a picture in the animation."""
    return {max(round(total * (i / (FRAMES - 1)) ** 2), 1) for i in range(FRAMES)}
