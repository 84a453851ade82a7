"""Runs that another command starts, or continues from where they were stopped."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatax.cli.settings import NAMES, Settings, as_started
from splatax.cli.starting import MAY_CHANGE, NewRun, ResumedRun
from splatax.cli.training import train
from splatax.runs.checkpoints import files
from splatax.runs.records import understood
from splatax.runs.resume import OTHER, find


def carry_on(settings: Settings, out: Path) -> None:
    """Starts a run, or continues it from its last checkpoint.

    Raises:
        InputError: if the run that was stopped has other settings.
    """
    if not files(out) or settings.overwrite:
        train(NewRun(settings, steps_given=True))
        return
    earlier = find(out)
    with understood(earlier.path, OTHER):
        stored = as_before(settings, earlier.options)
    train(ResumedRun(stored, earlier.history, earlier=earlier))


def as_before(settings: Settings, stored: Mapping[str, Any]) -> Settings:
    """Returns the settings with which a run is continued.

    Args:
        settings: wanted now.
        stored: settings of the run, as JSON values.

    Raises:
        InputError: if others than those that may change are not those of the run.
    """
    now = settings.absolute()
    wanted = {name: getattr(now, name) for name in NAMES - {"out", "overwrite"}}
    return as_started(Settings, stored, wanted, MAY_CHANGE)
