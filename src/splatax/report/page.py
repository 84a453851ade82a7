"""The report of a run as HTML, and the filling of all templates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jinja2

from splatax.report.curves import training_curves
from splatax.report.pictures import data_uri, encoded, error_map
from splatax.report.verdict import Verdict
from splatax.runs.history import History
from splatax.runs.results import Comparison


@dataclass(frozen=True)
class Account:
    """The words and the main numbers of a report.

    Attributes:
        summary: the main results, as label and value.
        notes: lines about the capture.
        verdict: what is good and what is bad; None if nothing could be compared.
        map: picture of the cameras from above, as a data URI.
    """

    summary: dict[str, str]
    notes: Sequence[str] = ()
    verdict: Verdict | None = None
    map: str = ""


def report(
    title: str,
    account: Account,
    history: History,
    comparisons: Sequence[Comparison],
    animation: bytes,
) -> str:
    """Returns the report of a run as one HTML file that refers to no other.

    Args:
        title: of the run.
        account: what the report says before the curves and the pictures.
        history: record of the run.
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
        summary=account.summary,
        notes=account.notes,
        verdict=account.verdict,
        map=account.map,
        worst=views[0] if views else None,
        best=views[-1] if len(views) > 1 else None,
        curves=training_curves(history),
        animation=encoded(animation, "image/gif") if animation else "",
        views=views,
    )


def fill(template: str, **values: Any) -> str:
    """Returns a template of this package filled with values, which are escaped unless marked as safe."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("splatax.report", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template(template).render(values)
