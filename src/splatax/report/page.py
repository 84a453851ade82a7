"""The report of a run as HTML, and the filling of all templates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jinja2

from splatax.report.curves import training_curves
from splatax.report.gallery import Exhibit, Gallery, Judged
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
        judged: the photos of which the verdict speaks.
    """

    summary: dict[str, str]
    notes: Sequence[str] = ()
    verdict: Verdict | None = None
    map: str = ""
    judged: Judged = Judged(())


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
        gallery: the test views, or training views where none are held out, for the list of all views.
        animation: a GIF of the run; may be empty.
    """
    return fill(
        "page.html",
        title=title,
        summary=account.summary,
        notes=account.notes,
        verdict=account.verdict,
        map=account.map,
        judged=account.judged,
        worst=_worst(account),
        curves=training_curves(history),
        animation=encoded(animation, "image/gif") if animation else "",
        views=gallery.worst,
        scores=sorted(gallery.scores, key=lambda score: score.psnr),
    )


def _worst(account: Account) -> Exhibit | None:
    """Returns the worst photo with pictures, unless a complaint shows one already."""
    pictures, complaints = account.judged.pictures, account.verdict.bad if account.verdict else ()
    if any(complaint.photo in pictures for complaint in complaints):
        return None
    return next(iter(pictures.values()), None)


def fill(template: str, **values: Any) -> str:
    """Returns a template of this package filled with values, which are escaped unless marked as safe."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("splatax.report", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template(template).render(values)
