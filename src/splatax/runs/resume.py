"""Resuming a run: its newest checkpoint, and checks that nothing has changed since."""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from splatax.dataset import Dataset
from splatax.errors import FormatError, InputError
from splatax.runs.checkpoints import FOLDER, files
from splatax.runs.history import History, unpacked
from splatax.runs.machine import DECISIVE, device, versions
from splatax.runs.records import as_json, understood
from splatax.training import checkpoint
from splatax.training.checkpoint import Checkpoint
from splatax.training.fingerprints import fingerprint
from splatax.training.loop import RunState
from splatax.training.recipes import Recipe

Run = TypeVar("Run")
FACTS = {"options": dict, "recipe": dict, "capture": dict, "versions": dict, "device": str}
TRAIN = "train"  # the command of runs that do not name theirs among their options
MISSING = "missing"
MOST_NAMED = 3  # changes that a message names; the rest are counted
OTHER = "Resume from another one in its folder, or start the run again."


@dataclass(frozen=True)
class Earlier:
    """A run that was stopped.

    Attributes:
        path: of a checkpoint.
        run: folder of the run.
        checkpoint: its contents.
        history: the record of the run until then.
        facts: about the run; see the function `facts`.
    """

    path: Path
    run: Path
    checkpoint: Checkpoint
    history: History
    facts: Mapping[str, Any]

    @property
    def options(self) -> dict[str, Any]:
        """The options that the run was started with, as JSON values.

        Raises:
            InputError: if another version of splatax or of a package that decides its steps started it.
        """
        self._require("versions", {name: versions()[name] for name in DECISIVE})
        return self.facts["options"]

    def state(self, recipe: Recipe, dataset: Dataset) -> RunState:
        """Returns the run on the device. Warns if the rest cannot be the same bit for bit.

        Raises:
            InputError: if recipe or capture are not those of the run.
        """
        return self.restored(facts({}, recipe, dataset), lambda: checkpoint.restore(self.checkpoint, recipe))

    def restored(self, now: Mapping[str, Any], restore: Callable[[], Run]) -> Run:
        """Returns the run on the device. Warns if the rest cannot be the same bit for bit.

        Args:
            now: facts about the run that would be resumed; see the function `facts`.
            restore: reads the state in the checkpoint.

        Raises:
            InputError: if recipe or capture are not those of the run.
        """
        for subject in ("recipe", "capture"):
            self._require(subject, now[subject])
        if self.facts["device"] != now["device"]:
            warnings.warn(
                f"the run was started on {self.facts['device']}, this is {now['device']}: the result will be "
                "equivalent, but not the same bit for bit",
                stacklevel=2,
            )
        with understood(self.path, OTHER):
            try:
                return restore()
            except FormatError as error:
                raise FormatError(f"{self.path}: {error}.") from error

    def _require(self, subject: str, now: Mapping[str, Any]) -> None:
        if changes := told(differences(self.facts[subject], now)):
            raise InputError(
                f"{self.path}: cannot be resumed, because the {subject} of the run changed: {changes}. "
                "Put it back as it was, or start a new run."
            )


def facts(options: Mapping[str, Any], recipe: Recipe, dataset: Dataset) -> dict[str, Any]:
    """Returns what a run is made of, as JSON values: the header of its checkpoints."""
    return {
        "options": as_json(options),
        "recipe": as_json(recipe),
        "capture": fingerprint(dataset),
        "versions": {name: versions()[name] for name in DECISIVE},
        "device": device(),
    }


def find(path: Path, command: str = TRAIN) -> Earlier:
    """Returns the checkpoint at a path, or the newest one of the run in a folder.

    Args:
        path: of the checkpoint or the folder.
        command: command that makes such runs.

    Raises:
        InputError: if there is none, it is damaged, or another command made it.
    """
    if path.is_dir():
        run, chosen = path, newest(path)
    elif path.exists():
        run, chosen = path.parent.parent, path
        if path.parent.name != FOLDER or path.suffix != ".npz":
            raise InputError(f"{path}: no checkpoint. Give the folder of a run, or a file in its {FOLDER}/.")
    else:
        raise InputError(f"{path}: no such run. Give the folder of a run that was stopped.")
    try:
        saved = checkpoint.read(chosen)
        with understood(chosen, ""):
            known = {name: kind(saved.header["run"][name]) for name, kind in FACTS.items()}
            own = str(known["options"].pop("command", TRAIN))
            if own != command:
                raise InputError(
                    f"{chosen}: a run of splatax {own}, not of splatax {command}. Resume it with that "
                    "command."
                )
            return Earlier(chosen, run, saved, unpacked(dict(saved.header), dict(saved.arrays)), known)
    except FormatError as error:
        older = [file for file in files(run) if file.name < chosen.name]
        way_out = "Resume from the one before" if older else "Start the run again"
        options = (f"resume {older[-1]}",) if older else ()
        raise FormatError(f"{str(error).rstrip()} {way_out}.", options=options) from error


def newest(run: Path) -> Path:
    """Returns the latest checkpoint in the folder of a run.

    Raises:
        InputError: if there is none.
    """
    found = files(run)
    if found:
        return found[-1]
    if (run / "report.html").exists():
        raise InputError(f"{run}: this run has already finished; nothing to resume.")
    if (run / "scene.ply").exists():
        raise InputError(
            f"{run}: holds a scene, but neither its report nor a checkpoint to write it from. Evaluate the "
            "scene by itself, or train again.",
            options=("overwrite",),
        )
    raise InputError(f"{run}: no checkpoint. If a run was stopped here before its first, start it again.")


def told(changes: Iterable[str]) -> str:
    """Returns changes as part of a message, which names the first few and counts the others; "" for none."""
    every = list(changes)
    named, more = every[:MOST_NAMED], len(every) - MOST_NAMED
    return "; ".join([*named, f"and {more:,} more"] if more > 0 else named)


def differences(then: Any, now: Any, name: str = "") -> Iterator[str]:
    """Yields what differs between two JSON values, in words."""
    if isinstance(then, dict) and isinstance(now, dict):
        for key in [*then, *(key for key in now if key not in then)]:
            yield from differences(then.get(key, MISSING), now.get(key, MISSING), f"{name} {key}".strip())
    elif then != now:
        yield f"{name} was {then}, is {now}"
