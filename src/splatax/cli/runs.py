"""Finished runs, read back from their folders."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatax.errors import InputError

OPTIONS = {"scene", "recipe", "background"}
METRICS = {"test", "gaussians", "train_seconds", "steps", "peak_rss_bytes", "evaluations", "protocol"}
PROTOCOL = {"images", "psnr", "ssim", "corrected_psnr", "number of masks"}  # what makes numbers comparable


@dataclass(frozen=True)
class FinishedRun:
    """What a run left, but for its scene.

    Attributes:
        name: tells it from the others.
        folder: of its files.
        options: that it was started with.
        metrics: that it was measured by.
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
        """How it was measured."""
        return self.metrics["protocol"] | {"number of masks": self.metrics.get("masked_test_views", 0)}

    @property
    def test_psnr(self) -> dict[str, float]:
        """Of each test view, dB."""
        return {view["name"]: psnr_of(view) for view in self.metrics["test"]["views"]}


def psnr_of(measures: dict[str, Any]) -> float:
    """PSNR as JSON has it, dB: null is infinite."""
    return math.inf if measures["psnr"] is None else measures["psnr"]


def read_runs(folders: Sequence[Path]) -> list[FinishedRun]:
    """Reads runs, and names each after its folder, or its whole path where two have one name.

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
        if not runs[-1].metrics.get("test"):
            raise InputError(
                f"{folder}: a run without test photos has nothing to be compared by. Leave it out."
            )
    return runs


def finished(run: Path, names: set[str]) -> tuple[dict[str, Any], list[tuple[int, int]]]:
    """Options of a finished run, and the changes of its number of steps, to make it again.

    Args:
        run: its folder, or the config.json in it.
        names: of the options that there are.

    Raises:
        InputError: if there is none, or it was made with other options.
    """
    path = run / "config.json" if run.is_dir() else run
    options = part_of(path, set(), within="options")
    if options.keys() != names:
        other = ", ".join(sorted(options.keys() ^ names))
        raise InputError(f"{path}: of a splatax with other options ({other}). Repeat the run with that one.")
    return options, [(step, total) for step, total in part_of(path, {"changes"})["changes"]]


def part_of(path: Path, needed: set[str], within: str | None = None) -> dict[str, Any]:
    """An object of a JSON file, or the one that it has under a name.

    Raises:
        InputError: if the file or anything of what is needed is missing.
    """
    try:
        contents = json.loads(path.read_text())
        contents = contents[within] if within else contents
        missing = needed - contents.keys()
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            f"{path.parent}: no {path.name} in it. Give folders that `splatax train` has written to the end."
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Make it readable.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: damaged ({error}). Train this run again, or leave it out.") from error
    if missing:
        raise InputError(f"{path}: no {min(missing)!r} in it. Train this run again, or leave it out.")
    return contents


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
                "of one capture; if it has moved, say where it is: --scene."
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
                    f"{run.folder}: measured otherwise than {first.folder}: {name} is "
                    f"{run.protocol[name]!r}, there {first.protocol[name]!r}. Train one of them again."
                )
