"""The report of a run: one HTML file that needs nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jinja2

from splatax.dataset import Mask
from splatax.evaluation import ViewScore
from splatax.report.curves import training_curves
from splatax.report.history import History
from splatax.report.pictures import Picture, data_uri, encoded, error_map


@dataclass(frozen=True)
class Comparison:
    """A test view: its photo, and what the scene shows from there; which pixels count (None: all)."""

    score: ViewScore
    photo: Picture
    image: Picture
    mask: Mask | None = None


def report(
    title: str,
    summary: dict[str, str],
    notes: Sequence[str],
    history: History,
    comparisons: Sequence[Comparison],
    animation: bytes,
) -> str:
    """The page.

    Args:
        title: of the run.
        summary: what to know at a glance, as label and value.
        notes: lines about the capture.
        history: of the run.
        comparisons: of the test views, or of training views where none are held out.
        animation: a GIF of the run; may be empty.
    """
    worst_first = sorted(comparisons, key=lambda comparison: comparison.score.psnr)
    views = [
        {
            "score": comparison.score,
            "mask": comparison.mask is not None,
            "photo": data_uri(comparison.photo),
            "image": data_uri(comparison.image),
            "error": data_uri(error_map(comparison.image, comparison.photo, comparison.mask)),
        }
        for comparison in worst_first
    ]
    return fill(
        "page.html",
        title=title,
        summary=summary,
        notes=notes,
        curves=training_curves(history),
        animation=encoded(animation, "image/gif") if animation else "",
        views=views,
    )


def fill(template: str, **values: Any) -> str:
    """A page of this package, with all that is not said to be safe escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("splatax.report", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template(template).render(values)
