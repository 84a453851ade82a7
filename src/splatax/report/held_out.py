"""The file held_out.json of a run: what a run of the capture without held-out photos quotes from it."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from splatax.evaluation import ViewScore
from splatax.report.gallery import Exhibit, Judged, Symptoms
from splatax.runs.finished import AGAIN, FinishedRun, psnr_of
from splatax.runs.planning import ENOUGH_STEPS
from splatax.runs.records import as_json, read_record, typed, understood

NAME = "held_out.json"
MOST = 6  # photos with pictures, the worst
WAY_OUT = "Delete it: the report then names only causes that need no pictures."


def stored(judged: Judged) -> bytes:
    """Returns the contents of the file, without error maps."""
    worst = list(judged.pictures.items())[:MOST]
    contents = {
        "symptoms": {name: asdict(each) for name, each in judged.symptoms.items()},
        "pictures": {name: _as_json(each) for name, each in worst},
        "best": judged.best and _as_json(judged.best),
    }
    return (json.dumps(as_json(contents), indent=2) + "\n").encode()


def quoted(run: FinishedRun) -> Judged:
    """Returns the photos that a run held out, with what is known about them: scores only, without the file.

    Raises:
        FormatError: if the file is damaged.
    """
    with understood(run.folder / "metrics.json", AGAIN):
        scores = tuple(map(_score, run.metrics["test"]["views"]))
    steps = run.metrics["steps"]
    hasty = steps if steps < ENOUGH_STEPS else 0
    path = run.folder / NAME
    try:
        contents = read_record(path, WAY_OUT)
    except FileNotFoundError:
        return Judged(scores, hasty=hasty)
    with understood(path, WAY_OUT):
        return Judged(
            scores,
            {name: _symptoms(each) for name, each in contents["symptoms"].items()},
            {name: _exhibit(each) for name, each in contents["pictures"].items()},
            None if contents["best"] is None else _exhibit(contents["best"]),
            hasty=hasty,
        )


def _as_json(exhibit: Exhibit) -> dict[str, Any]:
    return asdict(exhibit) | {"error": ""}


def _symptoms(contents: Mapping[str, Any]) -> Symptoms:
    """Returns symptoms from JSON values. Older files have more of them, which do not count."""
    return Symptoms(**{f.name: typed(contents[f.name], bool, f.name) for f in fields(Symptoms)})


def _exhibit(contents: Mapping[str, Any]) -> Exhibit:
    pictures = {name: typed(contents[name], str, name) for name in ("photo", "image", "error")}
    return Exhibit(_score(contents["score"]), typed(contents["masked"], bool, "masked"), **pictures)


def _score(contents: Mapping[str, Any]) -> ViewScore:
    """Returns a score from JSON values. A PSNR that is null is infinite."""
    corrected = contents["corrected_psnr"]
    return ViewScore(
        typed(contents["name"], str, "name"),
        typed(psnr_of(dict(contents)), float, "psnr"),
        typed(contents["ssim"], float, "ssim"),
        math.inf if corrected is None else typed(corrected, float, "corrected_psnr"),
    )
