"""Going on with a run: its newest checkpoint, and whether all is as it was."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import splatax as sx
from splatax.cli.checkpoints import FOLDER, files, unpacked
from splatax.cli.output import say
from splatax.cli.platform import device, versions
from splatax.cli.results import as_json
from splatax.errors import FormatError, InputError
from splatax.report.history import History
from splatax.runs.records import understood
from splatax.training import checkpoint
from splatax.training.checkpoint import Checkpoint
from splatax.training.loop import RunState

DECISIVE = ("splatax", "jax", "jaxlib", "numpy", "optax")  # packages whose version decides what a step does

FACTS = {"options": dict, "recipe": dict, "capture": dict, "versions": dict, "device": str}
OTHER = "Go on from another one in its folder, or start the run again."


@dataclass(frozen=True)
class Earlier:
    """A checkpoint, and the folder of its run."""

    path: Path
    run: Path
    checkpoint: Checkpoint
    history: History  # of the run until then
    facts: Mapping[str, Any]  # that the run was made of; see `facts`

    @property
    def options(self) -> dict[str, Any]:
        """That the run was started with, as JSON values.

        Raises:
            InputError: if it was by another version.
        """
        self._require("versions", {name: versions()[name] for name in DECISIVE})
        return self.facts["options"]

    def state(self, recipe: sx.Recipe, dataset: sx.Dataset) -> RunState:
        """The run on the device. Says so where it cannot go on bit for bit.

        Raises:
            InputError: if recipe or capture are not those of the run.
        """
        now = facts({}, recipe, dataset)
        for subject in ("recipe", "capture"):
            self._require(subject, now[subject])
        if self.facts["device"] != now["device"]:
            say(
                f"the run was started on {self.facts['device']}, this is {now['device']}: "
                "what comes out is as good, but not the same bit for bit"
            )
        with understood(self.path, OTHER):
            try:
                return checkpoint.restore(self.checkpoint, recipe)
            except FormatError as error:
                raise FormatError(f"{self.path}: {error}.") from error

    def _require(self, subject: str, now: Mapping[str, Any]) -> None:
        changes = "; ".join(differences(self.facts[subject], now))
        if changes:
            raise InputError(
                f"{self.path}: cannot go on, because the {subject} of the run changed: {changes}. Put it "
                "back as it was, or start a new run."
            )


def facts(options: Mapping[str, Any], recipe: sx.Recipe, dataset: sx.Dataset) -> dict[str, Any]:
    """What a run was made of, as JSON values."""
    return {
        "options": as_json(options),
        "recipe": as_json(recipe),
        "capture": checkpoint.fingerprint(dataset),
        "versions": {name: versions()[name] for name in DECISIVE},
        "device": device(),
    }


def find(path: Path) -> Earlier:
    """The checkpoint at a path, or the newest of the run in a folder.

    Raises:
        InputError: if there is none, or it is damaged.
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
            return Earlier(chosen, run, saved, unpacked(saved), known)
    except FormatError as error:
        older = [file for file in files(run) if file.name < chosen.name]
        way_out = f"Go on from the one before: --resume {older[-1]}" if older else "Start the run again"
        raise FormatError(f"{str(error).rstrip()} {way_out}.") from error


def newest(run: Path) -> Path:
    """The latest checkpoint in the folder of a run.

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
            f"{run}: holds a scene, but neither its report nor a checkpoint to write it from. Measure the "
            f"scene: splatax eval {run} CAPTURE, or train again: --overwrite."
        )
    raise InputError(f"{run}: no checkpoint. If a run was stopped here before its first, start it again.")


def differences(then: Any, now: Any, name: str = "") -> Iterator[str]:
    """What is not the same in two JSON values, in words."""
    if isinstance(then, dict) and isinstance(now, dict):
        for key in [*then, *(key for key in now if key not in then)]:
            yield from differences(then.get(key), now.get(key), f"{name} {key}".strip())
    elif then != now:
        yield f"{name} was {then}, is {now}"
