"""Finished runs, read back from their folders."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from splatax.errors import InputError
from splatax.runs.machine import DECISIVE, versions
from splatax.runs.records import read_record, typed, understood
from splatax.training.backgrounds import BACKGROUNDS

AGAIN = "Train this run again, or leave it out."
OPTIONS = {"scene": str, "recipe": str, "background": Literal[*BACKGROUNDS, None]}
SIZE = Literal["auto"] | int  # of the option downscale
METRICS = {
    "test": dict | None,
    "gaussians": int,
    "train_seconds": float,
    "steps": int,
    "peak_rss_bytes": int | None,
    "evaluations": list,
    "protocol": dict,
}
NUMBER = float | None  # null where it is infinite
PROTOCOL = {"images", "psnr", "ssim", "corrected_psnr", "number of masks"}  # what makes numbers comparable


@dataclass(frozen=True)
class FinishedRun:
    """A finished run as its files tell it, except for its scene.

    Attributes:
        name: distinguishes it from other runs.
        folder: of its files.
        options: options that it was started with.
        metrics: from metrics.json.
    """

    name: str
    folder: Path
    options: dict[str, Any]
    metrics: dict[str, Any]

    @property
    def scene(self) -> Path:
        """The folder of its capture."""
        return Path(self.options["scene"])

    @property
    def protocol(self) -> dict[str, Any]:
        """The protocol by which the run was measured."""
        return self.metrics["protocol"] | {"number of masks": self.metrics.get("masked_test_views", 0)}

    def check(self) -> None:
        """Raises TypeError or KeyError if a measure is missing or no number."""
        test = self.metrics["test"]
        if test is None:
            test = {"psnr": None, "ssim": None, "views": []}
        for measures in (test, *self.metrics["evaluations"], *test["views"]):
            typed(measures["psnr"], NUMBER, "psnr")
        for view in test["views"]:
            typed(view["name"], str, "name")
        for evaluation in self.metrics["evaluations"]:
            typed(evaluation["seconds"], float, "seconds")
        typed(test["ssim"], NUMBER, "ssim")
        typed(test.get("corrected_psnr"), NUMBER, "corrected_psnr")
        typed(self.metrics.get("masked_test_views", 0), int, "masked_test_views")

    @property
    def test_psnr(self) -> dict[str, float]:
        """PSNR of each test view, dB."""
        return {view["name"]: psnr_of(view) for view in self.metrics["test"]["views"]}


def psnr_of(measures: dict[str, Any]) -> float:
    """Returns a PSNR of a JSON record, dB: null is infinite."""
    return math.inf if measures["psnr"] is None else measures["psnr"]


def read_runs(folders: Sequence[Path]) -> list[FinishedRun]:
    """Reads runs. Each is named after its folder, or after its whole path where two folders have one name.

    Raises:
        InputError: if a folder is not that of a finished run, or is given twice.
    """
    runs: list[FinishedRun] = []
    for folder in folders:
        if folder.resolve() in {run.folder.resolve() for run in runs}:
            raise InputError(f"{folder}: given twice. Give each run once.")
        unique = sum(other.resolve().name == folder.resolve().name for other in folders) == 1
        name = folder.resolve().name if unique else str(folder)
        options = part_of(folder / "config.json", OPTIONS, within="options")
        runs.append(FinishedRun(name, folder, options, part_of(folder / "metrics.json", METRICS)))
        with understood(folder / "metrics.json", AGAIN):
            runs[-1].check()
        if not runs[-1].metrics.get("test"):
            raise InputError(f"{folder}: a run without test photos cannot be compared. Leave it out.")
    return runs


def finished(run: Path, names: set[str]) -> tuple[dict[str, Any], list[tuple[int, int]]]:
    """Returns the options of a finished run and the changes of its number of steps, to repeat it.

    Args:
        run: its folder, or the config.json in it.
        names: of the options that this version has.

    Raises:
        InputError: if there is no such run, it was stopped early, or it was made with other options.
    """
    if not run.exists():
        raise InputError(f"{run}: no such run. Give the folder of a finished run.")
    path = run / "config.json" if run.is_dir() else run
    if path.suffix != ".json":
        raise InputError(f"{path}: not the settings of a run. Give the folder of a finished run.")
    options = part_of(path, {}, within="options")
    if run.is_dir() and part_of(run / "metrics.json", {}).get("interrupted"):
        raise InputError(
            f"{run}: this run was stopped early, so it can only be resumed. Resume it to its end, and repeat "
            "it then.",
            options=(f"resume {run}",),
        )
    if options.keys() != names:
        other = ", ".join(sorted(options.keys() ^ names))
        raise InputError(
            f"{path}: from a version of splatax with other options ({other}). Repeat the run with that "
            "version."
        )
    made = part_of(path, {"changes": list})["changes"]
    with understood(path, AGAIN):
        return options, [(typed(step, int, "a step"), typed(total, int, "a total")) for step, total in made]


def version_changes(run: Path) -> list[str]:
    """Returns the packages that decide what a step does and had another version in a finished run, in words.

    Args:
        run: its folder, or the config.json in it.
    """
    path = run / "config.json" if run.is_dir() else run
    then, now = part_of(path, {}, within="versions"), versions()
    return [
        f"{name} was {then.get(name)}, is {now[name]}" for name in DECISIVE if then.get(name) != now[name]
    ]


def options_beside(model: Path) -> dict[str, Any]:
    """Returns the options of the run that made a splat file, from the config.json beside it.

    Empty if there is none, or it is that of another program.

    Raises:
        InputError: if the file is damaged.
    """
    path = model.parent / "config.json"
    if not path.is_file():
        return {}
    way_out = "Put it back as it was; or remove it, and say how the scene was trained where that matters."
    contents = read_record(path, way_out)
    if "options" not in contents or "recipe" not in contents:
        return {}
    with understood(path, way_out):
        return check_options(contents["options"])


def check_options(options: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of a run if those that other commands use make sense.

    Raises:
        TypeError: or another error, if they do not.
    """
    for name, kind in OPTIONS.items():
        typed(options[name], kind, name)
    if (divisor := typed(options.get("downscale", "auto"), SIZE, "downscale")) != "auto" and divisor < 1:
        raise TypeError(f"downscale is {divisor}")
    return options


def part_of(path: Path, needed: Mapping[str, Any], within: str | None = None) -> dict[str, Any]:
    """Returns the object of a JSON file, or the one that it has under a name.

    Args:
        path: of the file.
        needed: types of the values that it must have, by name.
        within: name of the object in that of the file.

    Raises:
        InputError: if the file or anything of what is needed is missing or damaged.
    """
    try:
        contents = read_record(path, AGAIN)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path.parent}: no {path.name} in it. Give folders of finished runs.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Make it readable.") from error
    with understood(path, AGAIN):
        part = contents[within] if within else contents
        for name, kind in needed.items():
            typed(part[name], kind, name)
        return check_options(part) if within == "options" and needed else dict(part)


def check_comparable(runs: Sequence[FinishedRun], *, scene_given: bool) -> None:
    """Checks that all runs are of one capture, and tested on the same photos in the same way.

    Args:
        runs: two or more.
        scene_given: the user says which capture it is, so its place may differ.

    Raises:
        InputError: if not; it says what differs.
    """
    first, *others = runs
    for run in others:
        if not scene_given and run.scene.resolve() != first.scene.resolve():
            raise InputError(
                f"{run.folder}: trained on {run.scene}, but {first.folder} on {first.scene}. Compare runs "
                "of one capture; if it has moved, say where it is.",
                options=("scene",),
            )
        ours, theirs = set(run.test_psnr), set(first.test_psnr)
        if ours != theirs:
            example = min(ours ^ theirs)
            tested, untested = (run, first) if example in ours else (first, run)
            raise InputError(
                f"{tested.folder}: tested on {example}, which {untested.folder} is not. Compare runs with "
                "the same split of the photos."
            )
        for name in sorted(PROTOCOL & run.protocol.keys() & first.protocol.keys()):
            if run.protocol[name] != first.protocol[name]:
                raise InputError(
                    f"{run.folder}: measured differently from {first.folder}: {name} is "
                    f"{run.protocol[name]!r}, there {first.protocol[name]!r}. Train one of them again."
                )
