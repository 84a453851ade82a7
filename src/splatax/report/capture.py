"""The findings of `splatax inspect`: facts for a terminal, and a self-contained HTML file."""

from collections import Counter
from collections.abc import Container, Sequence

import numpy as np

from splatax.dataset import photos_in
from splatax.inspection import Examination, Problem
from splatax.inspection.looks import Look
from splatax.io.datasets.photos import counted, sizes_of
from splatax.report.page import fill
from splatax.report.pictures import encoded
from splatax.report.plan import plan

LENSES = 4  # lenses that are listed
MOST = 300  # photos with pictures, which take 16 MB if all are noise


def facts_of(found: Examination) -> list[tuple[str, str]]:
    """Returns the contents of a capture as labels and values."""
    facts = []
    if found.dataset is None:
        facts.append(("photos", f"{len(found.photos)}, without poses"))
    else:
        unused = len(found.dataset.survey.unused)
        held_out = photos_in(found.dataset.test)
        facts.append(("photos", f"{len(found.views) + unused}, of which {len(found.views)} have a pose"))
        facts.append(("held out", f"{held_out} for testing"))
        facts.append(("size", f"{sizes_of(list(found.views))} as trained"))
        lenses = Counter(found.dataset.survey.lenses.values()).most_common()
        facts += [("lens", f"{lens}  ({counted(count)})") for lens, count in lenses[:LENSES]]
        if len(lenses) > LENSES:
            facts.append(("lens", f"and {len(lenses) - LENSES} more"))
        facts.append(("points", f"{len(found.dataset.points):,}"))
    if found.panoramas:
        views = found.dataset.views if found.dataset else ()
        faces = sum(view.face_of is not None for view in views)
        kind = f"in {faces} faces" if faces else "equirectangular"
        facts.append(("360 degrees", f"{counted(len(found.panoramas))}, {kind}"))
    if found.errors:
        middle, worst = (
            np.median(list(found.errors.values())),
            max(found.errors, key=found.errors.__getitem__),
        )
        facts.append(
            ("reprojection error", f"{middle:.2f} px, at worst {found.errors[worst]:.2f} px in {worst}")
        )
    if found.coverage:
        facts.append(("masks", f"{np.mean(list(found.coverage.values())):.0%} of pixels count"))
    if len(found.looks) < len(found.photos):
        facts.append(("examined", f"{len(found.looks)} of {len(found.photos)} photos, within the time limit"))
    if found.memory:
        free = f", {found.available / 1e9:.1f} GB are free here" if found.available else ""
        forecast = f"about {found.memory / 1e9:.1f} GB for {found.gaussians:,} Gaussians, as by default{free}"
        facts.append(("memory to train", forecast))
    if found.steps and found.seconds:
        run = f"{found.steps:,} steps to {found.gaussians:,} Gaussians, as busy as this machine is now"
        facts.append(("time to train", f"about {roughly(found.seconds)} by default: {run}"))
    return facts


def roughly(seconds: int | float) -> str:
    """Returns a time in words, such as "20 minutes" or "2.5 hours"."""
    minutes = max(round(seconds / 60), 1)
    return f"{minutes} minute{'s' * (minutes > 1)}" if minutes < 90 else f"{seconds / 3600:.1f} hours"


def verdict(problems: Sequence[Problem]) -> str:
    """Returns the number of problems in words, such as "2 problems, 1 of them serious"."""
    serious = sum(problem.severity == "error" for problem in problems)
    if not problems:
        return "No problems found"
    count, noun = len(problems), "problem" if len(problems) == 1 else "problems"
    if serious == count:
        return f"{count} serious {noun}"
    return f"{count} {noun}, {serious} of them serious" if serious else f"{count} {noun}"


def capture_page(found: Examination, problems: Sequence[Problem]) -> str:
    """Returns the page of a capture: pictures of at most `MOST` photos, and a table if there are more."""
    bad = {name for problem in problems for name in problem.photos}
    pictured = with_pictures([*found.looks], bad)
    measures = {name: measures_of(look, found.errors.get(name)) for name, look in found.looks.items()}
    rows = [{"name": name, "measures": each, "bad": name in bad} for name, each in measures.items()]
    thumbnails = {name: found.looks[name].thumbnail for name in pictured}
    return fill(
        "capture.html",
        title=f"Capture {found.path.resolve().name}",
        facts=facts_of(found),
        verdict=verdict(problems),
        problems=problems,
        plan=plan(found.dataset) if found.dataset else "",
        rows=rows,
        columns=[label for label, _ in max(measures.values(), key=len, default=[])],
        pictured=sorted((row for row in rows if row["name"] in pictured), key=lambda row: not row["bad"]),
        thumbnails={name: encoded(jpeg, "image/jpeg") for name, jpeg in thumbnails.items() if jpeg},
    )


def with_pictures(names: Sequence[str], bad: Container[str], most: int = MOST) -> set[str]:
    """Returns the names of the photos that a page shows: those with problems first, then a spread of others.

    Args:
        names: of all photos that were examined, in order.
        bad: names of the photos with problems.
        most: number of photos to show, at most.
    """
    groups = [name for name in names if name in bad], [name for name in names if name not in bad]
    chosen: set[str] = set()
    for group in groups:
        count = min(most - len(chosen), len(group))
        chosen.update(group[i * len(group) // count] for i in range(count))
    return chosen


def measures_of(look: Look, error: float | None) -> list[tuple[str, str]]:
    """Returns what was measured of a photo as labels and values.

    Args:
        look: of the photo.
        error: its median reprojection error, pixels; None if it is not known.
    """
    if look.unreadable:
        return [("cannot be read", "")]
    measures = [
        ("brightness", f"{look.luminance:.2f}"),
        ("white", f"{look.clipped:.1%}"),
        ("sharpness", f"{look.sharpness:,.0f}"),
    ]
    return measures if error is None else [*measures, ("reprojection error", f"{error:.2f} px")]
