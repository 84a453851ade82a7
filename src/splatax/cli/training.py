"""A training run, from its capture to its results.

In a run of several processes, process 0 decides about the run and writes its results; the others make
its steps with it.
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial

import jax

from splatax.cli.display import Display
from splatax.cli.finishing import written
from splatax.cli.hosts import receive_settings, send_settings
from splatax.cli.interruption import Interruption
from splatax.cli.output import say
from splatax.cli.preparing import loaded
from splatax.cli.settings import Settings
from splatax.cli.starting import Decided, Run, memory_for
from splatax.cli.train_options import Live
from splatax.cli.view import audience
from splatax.dataset import Dataset
from splatax.evaluation import require_scorable
from splatax.report import held_out
from splatax.runs.budget import DENSEST, longest_run
from splatax.runs.checkpoints import Checkpoints, NoCheckpoints
from splatax.runs.claim import claimed_for_run, require_space
from splatax.runs.clock import Changes, Clock
from splatax.runs.finished import FinishedRun, read_runs
from splatax.runs.history import History
from splatax.runs.keeping import with_photos_kept
from splatax.runs.planning import Room
from splatax.runs.results import Results, examples
from splatax.runs.resume import facts
from splatax.runs.session import Session, WorkerSession, all_made
from splatax.training.loop import RunState
from splatax.training.processes import broadcast, receive
from splatax.training.recipes import room_for


def train(run: Run, live: Live = Live()) -> None:
    """Trains a scene, and writes the results.

    Args:
        run: the run, as the user asks for it.
        live: the live viewer.

    Raises:
        InputError: if a setting makes no sense, a file cannot be read or written, or another process exits.
    """
    run = run.checked()
    if jax.process_index() == 0:
        lead(run, live)
    else:
        work(run)


def lead(run: Run, live: Live) -> None:
    """Decides what the settings leave open, trains, and writes the results: the work of process 0."""
    judge = judge_of(run.settings)
    dataset = loaded(run.settings)
    for note in dataset.notes:
        say(note)
    require_scorable(dataset.test or examples(dataset.train))
    with claimed_for_run(run.out, run.may_replace):
        decided = run.decided(dataset)
        send_settings(decided.settings)
        settings, dataset, history = decided.settings, decided.dataset, run.history
        recipe = settings.to_recipe(dataset)
        start = recipe.initialization.number(dataset)
        require_space(run.out, max(start, min(settings.most(dataset), DENSEST * room_for(dataset))))
        photos = kept_photos(dataset, decided.room)
        checkpoints = Checkpoints(
            run.out,
            facts(asdict(settings), recipe, dataset),
            seconds=settings.checkpoint_every,
            steps=settings.checkpoint_steps,
            earlier=run.checkpoint,
        )
        session = Session(
            photos,
            recipe,
            checkpoints,
            history,
            changes_of_steps(decided, history),
            eval_every=settings.eval_every,
            photo_room=decided.room.photos,
        )
        with checkpoints:
            last = make_steps(session, run.state(recipe, dataset), live)
            results = Results(run.title, dataset, recipe, history, last, asdict(settings), run.out, judge)
            written(results, checkpoints)
            broadcast(b"the results are written")
        if history.interrupted:
            say(f"stopped at step {history.steps:,}. Resume it: splatax train --resume {run.out}")


def work(run: Run) -> None:
    """Makes the steps of a run that process 0 leads, and waits until its results are written."""
    settings, dataset = receive_settings(run.settings)
    room = memory_for(settings, dataset)
    recipe = settings.to_recipe(dataset)
    session = WorkerSession(
        kept_photos(dataset, room),
        recipe,
        NoCheckpoints(settings.checkpoint_steps),
        run.history,
        Changes(run.history.changes),
        eval_every=settings.eval_every,
        photo_room=room.photos,
    )
    for _ in session.steps(run.state(recipe, dataset)):
        pass
    receive()


def judge_of(settings: Settings) -> FinishedRun | None:
    """Returns the run whose scores the report quotes, if any.

    Raises:
        InputError: if it is damaged. This is checked before the training.
    """
    if settings.judged_by is None:
        return None
    (judge,) = read_runs([settings.judged_by])
    held_out.quoted(judge)
    return judge


def kept_photos(dataset: Dataset, room: Room) -> Dataset:
    """Returns a capture whose photos are kept on disk where they do not fit in memory, and prints where."""
    kept, line = with_photos_kept(dataset, room)
    if line:
        say(line)
    if kept is not dataset:
        say("to remove the decoded photos: splatax cache --clear")
    return kept


def changes_of_steps(decided: Decided, history: History) -> Changes:
    """Returns what may change the number of steps during the run: the clock if time is limited."""
    seconds, deadline = decided.settings.seconds, decided.deadline
    if seconds is None:
        return Changes(history.changes)
    return Clock(
        history.changes,
        seconds,
        (history.steps, history.train_seconds),
        decided.expected,
        left=partial(deadline.left, decided.dataset) if deadline else None,
        longest=longest_run(len(decided.dataset.train)),
    )


def make_steps(session: Session, start: RunState | None, live: Live) -> RunState:
    """Makes the steps of a run with a progress bar, and shows them in the live viewer if requested.

    Ctrl-C ends training after the current step, in a run of one process.

    Returns:
        The run after its last step.
    """
    history, recipe = session.history, session.recipe
    if start:
        then = "writing the results" if all_made(start) else "resuming"
        say(f"{then} after step {history.steps:,} of {int(start.train.total):,}")
    watching = audience(session.dataset, recipe, live.host, live.port) if live.view else nullcontext()
    with watching as viewer, Display(recipe.steps) as display, interruption() as stop:
        session.stop_requested = lambda: stop.requested
        if not (start and all_made(start)):
            display.announce("compiling the first step")
        for progress in session.steps(start):
            display.steps, display.psnr = progress.total, history.psnr
            display.step(progress.step, progress.loss, progress.count)
            if viewer and viewer.waits:
                with session.paused(progress):
                    viewer.show(progress, history, session.stop_requested)
    assert session.last
    return session.last


def interruption() -> AbstractContextManager[Interruption]:
    """Returns a context that listens to Ctrl-C and SIGTERM, in a run of one process.

    Several processes would have to stop after the same step, so these signals end them at once.
    """
    return Interruption() if jax.process_count() == 1 else nullcontext(Interruption())
