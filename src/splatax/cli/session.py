"""One run as the command line makes it: training, watched."""

import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import splatax as sx
from splatax.budget import Changes
from splatax.cli.checkpoints import FOLDER, Checkpoints, files
from splatax.cli.display import Display
from splatax.cli.interruption import Interruption
from splatax.cli.view import Audience
from splatax.errors import InputError
from splatax.evaluation import picture
from splatax.io.files import write_whole
from splatax.report.history import Evaluation, History
from splatax.training.loop import RunState

FRAMES = 20  # of the animation, close together at first, when most happens


def claim(out: Path, overwrite: bool) -> None:
    """Makes the folder of a run, before any work is done for it.

    Raises:
        InputError: if it holds results that must not be replaced, or cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: a file, not a folder. Choose another --out.")
    if files(out) and not overwrite:
        raise InputError(
            f"{out}: holds a run that was stopped. Go on with it: splatax train --resume {out}, choose "
            "another --out, or replace it: --overwrite."
        )
    if (out / "scene.ply").exists() and not overwrite:
        raise InputError(
            f"{out}: holds the results of a run. Choose another --out, or replace it: --overwrite."
        )
    try:
        for folder in (out, out / FOLDER) if files(out) else (out,):
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(folder / ".writable", b"")
            (folder / ".writable").unlink()
    except OSError as error:
        raise InputError(f"{out}: cannot be written to ({error.strerror}). Choose another --out.") from error


@dataclass
class Stopwatch:
    """Seconds that count, without those spent on looking."""

    began: float
    paused: float = 0.0

    def seconds(self) -> float:
        return time.monotonic() - self.began - self.paused


def train(
    dataset: sx.Dataset,
    recipe: sx.Recipe,
    eval_every: int,
    checkpoints: Checkpoints,
    history: History,
    start: RunState | None = None,
    changes: Changes | None = None,
    audience: Audience | None = None,
) -> sx.Progress:
    """Trains with a progress bar, evaluations, pictures of one view and checkpoints; returns the end.

    Ctrl-C ends training after the step at hand, with what has been reached until then.

    Args:
        dataset: the capture.
        recipe: how.
        eval_every: steps between evaluations of the test views; 0 for none.
        checkpoints: where the run is saved now and then, and when it is interrupted.
        history: of the run until now; it grows.
        start: the run to go on with.
        changes: of the number of steps. Those of the history are made again.
        audience: who may look on; None for nobody.
    """
    changes = changes or Changes()
    changes.made = history.changes
    with Display(recipe.steps) as display, Interruption() as interruption:
        display.announce("compiling the first step")
        watch = Stopwatch(time.monotonic() - history.train_seconds)
        for progress in sx.optimize(dataset, recipe, start, changes):
            history.losses.append(progress.loss)
            history.counts.append(progress.count)
            display.steps = progress.total
            display.step(progress.step, progress.loss, progress.count)
            last = progress.step == progress.total
            looked = changes.due(progress.step, progress.total)
            shown = progress.step in frames(progress.total)
            evaluated = bool(eval_every and dataset.test) and progress.step % eval_every == 0 and not last
            stopped = interruption.requested and not last
            saved = not last and (checkpoints.due(progress.step) or stopped)
            watched = audience is not None and audience.waits
            if evaluated or saved or looked or shown or watched:
                progress.loss.block_until_ready()
                history.train_seconds = seconds = watch.seconds()
                if looked:
                    changes.note(progress.step, progress.total, seconds)
                if shown:
                    history.frames.append(frame(progress, dataset, recipe))
                if evaluated:
                    history.evaluations.append(evaluate(progress, dataset, recipe, seconds))
                    display.psnr = history.evaluations[-1].scores.psnr
                if saved:
                    checkpoints.save(progress.state, history)
                if audience and watched:
                    audience.show(progress, history, lambda: interruption.requested)
                watch.paused += watch.seconds() - seconds
            if stopped:
                history.interrupted = True
                break
        progress.loss.block_until_ready()
        history.train_seconds = watch.seconds()
    return progress


@cache
def frames(total: int) -> set[int]:
    """Steps that have a picture in the animation."""
    return {max(round(total * (i / (FRAMES - 1)) ** 2), 1) for i in range(FRAMES)}


def evaluate(progress: sx.Progress, dataset: sx.Dataset, recipe: sx.Recipe, seconds: float) -> Evaluation:
    """The test views in the middle of a run."""
    scores = sx.evaluate(
        progress.padded,
        dataset.test,
        background=recipe.background.rgb,
        low_pass=recipe.low_pass,
        backend=recipe.backend,
    )
    return Evaluation(progress.step, seconds, scores)


def frame(progress: sx.Progress, dataset: sx.Dataset, recipe: sx.Recipe):
    """A picture of the first test view, for the animation."""
    camera = (dataset.test or dataset.train)[0].camera
    image = picture(
        progress.padded,
        camera,
        background=recipe.background.rgb,
        low_pass=recipe.low_pass,
        backend=recipe.backend,
    )
    return f"step {progress.step:,}   {progress.count:,} Gaussians", image
