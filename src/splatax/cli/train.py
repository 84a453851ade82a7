"""`splatax train`: from a capture to a scene."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from splatax.cli.hosts import among_processes, joined
from splatax.cli.options import flag, given, parsed, shown_as
from splatax.cli.output import complain, say
from splatax.cli.settings import NAMES, Settings, as_started
from splatax.cli.starting import MAY_CHANGE, NewRun, RepeatedRun, ResumedRun, Run
from splatax.cli.train_options import Devices, Drawing, Limits, Live, Method, Photos, Rerun, Saving
from splatax.cli.training import train
from splatax.errors import InputError
from splatax.runs.budget import DEFAULT_BUDGET, parse_seconds
from splatax.runs.finished import finished, version_changes
from splatax.runs.history import History
from splatax.runs.planning import Deadline
from splatax.runs.records import understood
from splatax.runs.resume import OTHER, find
from splatax.training.recipes import PRESETS

NOT_REPEATED = {"out": None, "overwrite": False, "budget": None}  # a plan is repeated as it was made


@dataclass(frozen=True)
class Train:
    """Train a scene on a capture.

    Writes scene.ply, metrics.json, config.json, report.html and progress.gif. Ctrl-C ends training early
    and saves the current result, except with --hosts; --resume continues from there, or from the last
    checkpoint of a run that crashed, and produces the same scene as an uninterrupted run.
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
    drawing: Drawing = Drawing()
    saving: Saving = Saving()
    rerun: Rerun = Rerun()
    live: Live = Live()

    def run(self) -> None:
        began = time.monotonic()
        with joined(self.devices.hosts):
            run = self.asked(began)
            if jax.process_count() > 1:
                run = among_processes(run, self.saving, self.live)
            train(run, self.live)

    def asked(self, began: float) -> Run:
        """Returns the run that the options ask for.

        Args:
            began: time at which the command began, of the monotonic clock.
        """
        chosen = {name: value for name, value in given(self).items() if name in NAMES}
        if self.limits.within is not None and (self.rerun.resume or self.rerun.repeat):
            raise InputError(
                "--within: a resumed or repeated run has a fixed number of steps. Leave the option out."
            )
        if self.rerun.resume is not None and self.rerun.repeat is not None:
            raise InputError(
                "--resume: continues a run that was stopped, and --repeat makes a finished one again. Give "
                "one of them."
            )
        if self.rerun.resume is not None:
            return resumed(self.rerun.resume, chosen)
        if self.rerun.repeat is not None:
            return repeated(self.rerun.repeat, chosen)
        settings, deadline = limited(Settings(**chosen), self.limits, began)
        return NewRun(settings, steps_given=self.limits.steps is not None, deadline=deadline)


def resumed(path: Path, chosen: Mapping[str, Any]) -> ResumedRun:
    """Returns the run of a folder or checkpoint, with the options given now that may change."""
    earlier = find(path)
    with understood(earlier.path, OTHER):
        settings = as_started(Settings, earlier.options, chosen, MAY_CHANGE)
    return ResumedRun(settings, earlier.history, earlier=earlier)


def repeated(folder: Path, chosen: Mapping[str, Any]) -> RepeatedRun:
    """Returns the run of a folder again, with the options given now that may change."""
    stored, made = finished(folder, NAMES)
    if changes := version_changes(folder):
        complain(f"warning: the scene may not have the same bytes: {'; '.join(changes)}")
    with understood(folder, "Repeat another run."):
        settings = as_started(Settings, stored | NOT_REPEATED, chosen, MAY_CHANGE | {"out", "overwrite"})
    return RepeatedRun(settings, History(changes=made))


def limited(settings: Settings, limits: Limits, began: float) -> tuple[Settings, Deadline | None]:
    """Returns settings with a time budget unless a number of steps is given, and the command's deadline.

    Args:
        settings: as given.
        limits: as given.
        began: time at which the command began, of the monotonic clock.

    Raises:
        InputError: if a budget has nothing left to plan.
    """
    if settings.budget is None and limits.within is None:
        return with_default_budget(settings, limits), None
    require_plannable(settings, limits)
    if limits.within is None:
        return settings, None
    if settings.budget is not None:
        raise InputError("--within: limits the whole command, --budget the training. Give one of them.")
    seconds = parsed("within", limits.within, parse_seconds)
    return replace(settings, budget=f"{seconds:g}s"), Deadline(began + seconds)


def with_default_budget(settings: Settings, limits: Limits) -> Settings:
    """Returns settings with the default budget, which is printed, if their steps can be planned."""
    if settings.views > 1 or limits.steps is not None or not PRESETS[settings.recipe].plannable:
        return settings
    say(f"training for {DEFAULT_BUDGET}. Choose another time: --budget, or a number of steps: --steps")
    return replace(settings, budget=DEFAULT_BUDGET)


def require_plannable(settings: Settings, limits: Limits) -> None:
    """Raises InputError if the number of steps cannot follow from a time, or is given."""
    name = "budget" if limits.within is None else "within"
    if settings.views > 1:
        raise InputError(
            f"{flag(name)}: steps are planned by the measured speed of this machine for one photo in each "
            "step, which does not tell the speed of several photos on several devices. Leave out either "
            "this or --views; --steps sets the number of steps."
        )
    if limits.steps is not None or not PRESETS[settings.recipe].plannable:
        recipes = " or ".join(name for name, preset in PRESETS.items() if preset.plannable)
        raise InputError(
            f"{flag(name)}: plans the steps of the recipe {recipes}. Leave out --recipe and --steps."
        )
