"""`splatax train`: from a capture to a scene."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import tyro

from splatax.cli.display import Display
from splatax.cli.finishing import written
from splatax.cli.hosts import follow, joined, tell
from splatax.cli.interruption import Interruption
from splatax.cli.options import flag, given, parsed, shown_as
from splatax.cli.output import complain, say
from splatax.cli.preparing import loaded, planned, prepared
from splatax.cli.settings import NAMES, Settings, as_started
from splatax.cli.train_options import Devices, Limits, Live, Method, Photos, Rerun, Saving
from splatax.cli.view import audience
from splatax.dataset import Dataset, photos_in
from splatax.errors import InputError
from splatax.io.datasets.photos import counted
from splatax.io.memory import decoding
from splatax.report import held_out
from splatax.runs.budget import DEFAULT_BUDGET, Changes, Clock, Expected, parse_seconds
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.claim import claimed_for_run
from splatax.runs.finished import finished, read_runs, version_changes
from splatax.runs.history import History
from splatax.runs.keeping import with_photos_kept
from splatax.runs.planning import Deadline, gigabytes, room_within
from splatax.runs.records import understood
from splatax.runs.results import Results
from splatax.runs.resume import OTHER, Earlier, facts, find
from splatax.runs.session import Session, all_made
from splatax.training.loop import RunState
from splatax.training.processes import from_first
from splatax.training.recipes import PRESETS, steps_for

MAY_CHANGE = {"scene", "points", "judged_by", "title", "checkpoint_every", "checkpoint_steps"}  # on resuming
NOT_REPEATED = {"out": None, "overwrite": False, "budget": None}  # a plan is repeated as it was made


@dataclass(frozen=True)
class Train:
    """Train a scene on a capture.

    Writes scene.ply, metrics.json, config.json, report.html and progress.gif. Ctrl-C ends training early
    and saves the current result; --resume continues from there, or from the last checkpoint of a run that
    crashed, and produces the same scene as an uninterrupted run.
    """

    scene: Annotated[Path | None, tyro.conf.Positional, shown_as("CAPTURE")] = None
    """Folder of the capture, or a zip file of it: photos with a COLMAP model (images/ and sparse/0/),
    transforms.json, or another layout that docs/capture.md lists. For photos without poses, run splatax
    reconstruct first."""
    out: Annotated[Path | None, shown_as("FOLDER")] = None
    """Output folder. By default runs/NAME, with the name of the capture's folder."""
    title: Annotated[str | None, shown_as("TEXT")] = None
    """Title of the report. By default the name of the capture's folder."""
    overwrite: Annotated[bool, shown_as()] = False
    """Replace the results of an earlier run in the output folder."""
    photos: Photos = Photos()
    limits: Limits = Limits()
    devices: Devices = Devices()
    method: Method = Method()
    saving: Saving = Saving()
    rerun: Rerun = Rerun()
    live: Live = Live()

    def run(self) -> None:
        with joined(self.devices.hosts):
            self.run_here(time.monotonic())

    def run_here(self, began: float) -> None:
        """Runs the command in this process.

        Args:
            began: time at which the command began, of the monotonic clock.
        """
        chosen = {name: value for name, value in given(self).items() if name in NAMES}
        if self.limits.within is not None and (self.rerun.resume or self.rerun.repeat):
            raise InputError(
                "--within: a resumed or repeated run has a fixed number of steps. Leave the option out."
            )
        if self.rerun.resume is not None:
            earlier = find(self.rerun.resume)
            with understood(earlier.path, OTHER):
                settings = as_started(Settings, earlier.options, chosen, MAY_CHANGE)
            self.train(settings, earlier.history, earlier=earlier)
        elif self.rerun.repeat is not None:
            stored, made = finished(self.rerun.repeat, NAMES)
            if changes := version_changes(self.rerun.repeat):
                complain(f"warning: the scene may not have the same bytes: {'; '.join(changes)}")
            with understood(self.rerun.repeat, "Repeat another run."):
                free = MAY_CHANGE | {"out", "overwrite"}
                settings = as_started(Settings, stored | NOT_REPEATED, chosen, free)
            self.train(settings, History(changes=made))
        else:
            settings, deadline = self.limited(Settings(**chosen), began)
            self.train(settings, History(), deadline)

    def limited(self, settings: Settings, began: float) -> tuple[Settings, Deadline | None]:
        """Returns settings with a time budget unless a number of steps is given, and the command's deadline.

        Args:
            settings: as given.
            began: time at which the command began, of the monotonic clock.

        Raises:
            InputError: if a budget has nothing left to plan.
        """
        name = "within" if self.limits.within is not None else "budget"
        if settings.views > 1:
            if settings.budget is not None or self.limits.within is not None:
                raise InputError(
                    f"{flag(name)}: plans steps of one photo. Leave out either this or --views; "
                    "--steps sets the number of steps."
                )
            return settings, None
        plannable = PRESETS[settings.recipe].plannable and self.limits.steps is None
        if settings.budget is None and self.limits.within is None:
            if not plannable:
                return settings, None
            say(
                f"training for {DEFAULT_BUDGET}. Choose another time: --budget, or a number of steps: --steps"
            )
            return replace(settings, budget=DEFAULT_BUDGET), None
        if not plannable:
            recipes = " or ".join(name for name, preset in PRESETS.items() if preset.plannable)
            raise InputError(
                f"{flag(name)}: plans the steps of the recipe {recipes}. Leave out --recipe and --steps."
            )
        if self.limits.within is None:
            return settings, None
        if settings.budget is not None:
            raise InputError("--within: limits the whole command, --budget the training. Give one of them.")
        seconds = parsed("within", self.limits.within, parse_seconds)
        return replace(settings, budget=f"{seconds:g}s"), Deadline(began + seconds)

    def train(
        self,
        settings: Settings,
        history: History,
        deadline: Deadline | None = None,
        earlier: Earlier | None = None,
    ) -> None:
        """Trains, from the beginning or from a checkpoint, and writes the results.

        Args:
            settings: of the run.
            history: record of the run until now.
            deadline: of the whole command; None if only training is limited.
            earlier: the run to resume.
        """
        settings.check()
        if settings.scene is None:
            raise InputError("No capture is given. Name its folder, or a run to resume: --resume RUN.")
        settings = settings.absolute()
        assert settings.scene
        title = settings.title or settings.scene.resolve().name
        out = earlier.run if earlier else settings.out or Path("runs") / settings.scene.resolve().name
        if jax.process_count() > 1:
            if settings.views == 1 or self.live.view:
                raise InputError("--hosts: needs --views, and cannot be used with --view.")
            settings = replace(settings, checkpoint_every=0.0)  # the clocks of the processes differ
        if jax.process_index() > 0:
            follow(settings, history, earlier)
            return
        judge = read_runs([settings.judged_by])[0] if settings.judged_by else None
        if judge:
            held_out.quoted(judge)  # a damaged one is refused before the training
        dataset = loaded(settings)
        for note in dataset.notes:
            say(note)
        with claimed_for_run(out, settings.overwrite or earlier is not None):
            if not earlier and self.rerun.repeat is None:
                settings, dataset = prepared(settings, dataset, out)
            settings = replace(settings, background=settings.background or dataset.background)
            room = room_within(settings.memory_bytes, dataset, settings.initialization().number(dataset))
            if settings.memory_bytes:
                say(f"within {gigabytes(settings.memory_bytes)}: {room}")
            decoding.limit = room.decoding
            if not (earlier or self.rerun.repeat or settings.budget or self.limits.steps):
                settings = with_steps(settings, dataset)
            expected = None
            if earlier is None:
                settings, dataset, expected = planned(settings, dataset, room, deadline)
            tell(settings)
            recipe = settings.to_recipe(dataset)
            reading, kept = with_photos_kept(dataset, room)
            if kept:
                say(kept)
            if reading is not dataset:
                say("to remove the decoded photos: splatax cache --clear")
            checkpoints = Checkpoints(
                out,
                facts(asdict(settings), recipe, dataset),
                seconds=settings.checkpoint_every,
                steps=settings.checkpoint_steps,
                earlier=earlier.path if earlier else None,
            )
            session = Session(
                reading,
                recipe,
                checkpoints,
                history,
                pace(settings, history, expected, partial(deadline.left, dataset) if deadline else None),
                eval_every=settings.eval_every,
                photo_room=room.photos,
            )
            with checkpoints:
                last = self.steps(session, earlier.state(recipe, dataset) if earlier else None)
                results = Results(title, dataset, recipe, history, last, asdict(settings), out, judge)
                written(results, checkpoints)
                from_first(b"the results are written")
            if history.interrupted:
                say(f"stopped at step {history.steps:,}. Resume it: splatax train --resume {out}")

    def steps(self, session: Session, start: RunState | None) -> RunState:
        """Makes the steps of a run with a progress bar, and shows them in the live viewer if requested.

        Ctrl-C ends training after the current step.

        Returns:
            The run after its last step.
        """
        history, recipe = session.history, session.recipe
        if start:
            then = "writing the results" if all_made(start) else "resuming"
            say(f"{then} after step {history.steps:,} of {int(start.train.total):,}")
        watching = (
            audience(session.dataset, recipe, self.live.host, self.live.port)
            if self.live.view
            else nullcontext()
        )
        alone = jax.process_count() == 1  # else all would have to stop after the same step
        stopping = Interruption() if alone else nullcontext(Interruption())
        with watching as audience_, Display(recipe.steps) as display, stopping as interruption:
            session.stop_requested = lambda: interruption.requested
            if not (start and all_made(start)):
                display.announce("compiling the first step")
            for progress in session.steps(start):
                display.steps, display.psnr = progress.total, history.psnr
                display.step(progress.step, progress.loss, progress.count)
                if audience_ and audience_.waits:
                    with session.paused(progress):
                        audience_.show(progress, history, session.stop_requested)
        assert session.last
        return session.last


def with_steps(settings: Settings, dataset: Dataset) -> Settings:
    """Returns settings with the default number of steps, and prints it with several views or above 30,000."""
    seen, choose = steps_for(dataset), "Choose another number: --steps"
    steps = -(-seen // settings.views)
    if settings.views > 1:
        say(f"{steps:,} steps of {counted(settings.views)}, {seen:,} photos in all. {choose}")
    elif steps > settings.steps:
        count = photos_in(dataset.train)
        say(f"{steps:,} steps, {steps // count} for each of {counted(count)}. {choose}")
    return replace(settings, steps=steps)


def pace(
    settings: Settings,
    history: History,
    expected: Expected | None,
    left: Callable[[], float] | None = None,
) -> Changes:
    """Returns what may change the number of steps during the run; `left` is that of `Clock`."""
    if settings.seconds is None:
        return Changes(history.changes)
    checked = history.steps, history.train_seconds
    return Clock(history.changes, settings.seconds, checked, expected, left=left)
