"""The report of a run as HTML, and the filling of all templates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jinja2

from splatax.report.curves import training_curves
from splatax.report.gallery import Gallery
from splatax.report.pictures import encoded
from splatax.report.verdict import Verdict
from splatax.runs.history import History


@dataclass(frozen=True)
class Account:
    """The words and the main numbers of a report.

    Attributes:
        summary: the main results, as label and value.
        notes: lines about the capture.
        verdict: what is good and what is bad; None if nothing could be compared.
        map: picture of the cameras from above, as a data URI.
        pictured: which photos the pictures show, in words.
    """

    summary: dict[str, str]
    notes: Sequence[str] = ()
    verdict: Verdict | None = None
    map: str = ""
    pictured: str = "photos"


def report(
    title: str,
    account: Account,
    history: History,
    gallery: Gallery,
    animation: bytes,
) -> str:
    """Returns the report of a run as one HTML file that refers to no other.

    Args:
        title: of the run.
        account: what the report says before the curves and the pictures.
        history: record of the run.
        gallery: the test views, or training views where none are held out.
        animation: a GIF of the run; may be empty.
    """
    views = gallery.worst
    return fill(
        "page.html",
        title=title,
        summary=account.summary,
        notes=account.notes,
        verdict=account.verdict,
        map=account.map,
        pictured=account.pictured,
        worst=views[0] if views else None,
        best=gallery.best if len(gallery.scores) > 1 else None,
        curves=training_curves(history),
        animation=encoded(animation, "image/gif") if animation else "",
        views=views,
        scores=sorted(gallery.scores, key=lambda score: score.psnr),
    )


def fill(template: str, **values: Any) -> str:
    """Returns a template of this package filled with values, which are escaped unless marked as safe."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("splatax.report", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template(template).render(values)
