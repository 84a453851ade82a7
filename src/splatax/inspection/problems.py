"""Finds the problems of a capture, and suggests a fix for each."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from splatax.inspection.blur import blurred
from splatax.inspection.examination import Examination
from splatax.inspection.looks import Look
from splatax.inspection.outliers import outliers
from splatax.io.datasets.photos import counted, listed

FEW_VIEWS = 20
LEAST_EXPOSURE = 0.15  # standard deviation of log2 luminance
DARK, MUCH_WHITE = 0.08, 0.2  # mean luminance; fraction of white pixels
HIGH_ERROR = 1.5  # pixels, median
TWICE = 2.0  # times the median of all views, from which a view counts as badly placed
MOSTLY_HIDDEN = 0.2  # fraction of unmasked pixels
FEW_POINTS = 500
LEVEL_SPAN = 0.02  # of the distance to the points; less means that all cameras are in one place
TRIANGULATED = "splatax train finds some in the photos; in Python: reconstruction.triangulated(dataset.train)"


@dataclass(frozen=True)
class Problem:
    """Problem of a capture.

    Attributes:
        severity: an "error" prevents training or spoils the scene; a "warning" makes the scene worse.
        what: description of the problem.
        fix: suggestion to the user.
        photos: names of the photos that have the problem, also of those that `what` does not list.
    """

    severity: Literal["error", "warning"]
    what: str
    fix: str
    photos: tuple[str, ...] = ()


def problems_of(found: Examination) -> list[Problem]:
    """Returns all problems, errors first."""
    checks = (poses, number, shape, registration, placement, errors, photos, others, masks, points, memory)
    return errors_first(found, checks)


def problems_of_cameras(found: Examination) -> list[Problem]:
    """Returns the problems of the number of photos and of their cameras, errors first."""
    return errors_first(found, (number, registration, placement, errors))


def problems_of_points(found: Examination) -> list[Problem]:
    """Returns the problems of the points of a capture."""
    return errors_first(found, (points,))


def errors_first(
    found: Examination, checks: Sequence[Callable[[Examination], Iterator[Problem]]]
) -> list[Problem]:
    """Returns the problems that the checks find, errors first."""
    problems = [problem for check in checks for problem in check(found)]
    return sorted(problems, key=lambda problem: problem.severity != "error")


def poses(found: Examination) -> Iterator[Problem]:
    if found.dataset is None:
        fix = "Find them with splatax reconstruct."
        yield Problem("error", "The photos have no poses, so nothing can be trained on them yet.", fix)


def number(found: Examination) -> Iterator[Problem]:
    count = len(found.photos) if found.dataset is None else len(found.views)
    if count < FEW_VIEWS:
        yield Problem(
            "warning",
            f"Only {counted(count)}.",
            "Take 50 to 200, around the subject at two or three heights.",
        )


def shape(found: Examination) -> Iterator[Problem]:
    if found.wide:
        yield Problem(
            "warning",
            f"{are(list(found.wide))} twice as wide as high, like 360-degree photos, but their metadata do "
            f"not say that they are: {listed(found.wide)}.",
            "If they are, reconstruct them with panoramas all.",
            found.wide,
        )


def registration(found: Examination) -> Iterator[Problem]:
    if found.dataset is None:
        return
    if unused := found.dataset.survey.unused:
        yield Problem(
            "warning",
            f"{len(unused)} of {len(unused) + len(found.views)} photos have no pose: {listed(unused)}.",
            "Take them again with more overlap, or leave them out; the scene is not seen from there.",
            tuple(unused),
        )


def placement(found: Examination) -> Iterator[Problem]:
    if found.dataset is None or len(found.views) < 2:
        return
    positions = np.stack([np.asarray(view.camera.position, np.float64) for view in found.views])
    span = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    cloud = found.dataset.points.positions
    distance = float(np.median(np.linalg.norm(cloud - positions.mean(0), axis=1))) if len(cloud) else 0.0
    if span <= LEVEL_SPAN * distance:
        yield Problem(
            "error",
            "All photos were taken from one place, so they contain no information about depth.",
            "Walk sideways or around the subject instead of turning on the spot.",
        )


def errors(found: Examination) -> Iterator[Problem]:
    if not found.errors:
        return
    middle = float(np.median(list(found.errors.values())))
    bad = sorted(name for name, error in found.errors.items() if error > max(TWICE * middle, 1.0))
    if middle > HIGH_ERROR:
        yield Problem(
            "error" if middle > 4 * HIGH_ERROR else "warning",
            f"Points project {middle:.1f} pixels from where they were seen, in the median photo.",
            "Poses and photos do not belong together, or the lens was calibrated badly: use the "
            "same photos that the poses were found from, or run splatax reconstruct again.",
        )
    elif bad:
        yield Problem(
            "warning",
            f"{are(bad)} placed worse than the rest: {listed(bad)}.",
            "Remove them from the capture if they are blurred or something moved.",
            tuple(bad),
        )


def photos(found: Examination) -> Iterator[Problem]:
    """Yields problems of the photos themselves: unreadable ones, and outliers in exposure and sharpness."""
    seen = {name: look for name, look in found.looks.items() if not look.unreadable}
    if broken := sorted(found.looks.keys() - seen.keys()):
        why = found.looks[broken[0]].unreadable
        what = f"{counted(len(broken))} cannot be read: {listed(broken)} ({why.removesuffix('.')})."
        yield Problem("error", what, "Copy them from the camera again.", tuple(broken))
    if seen:
        yield from exposure(seen)
        yield from blur(seen)


def others(found: Examination) -> Iterator[Problem]:
    """Yields the files among photos without poses that cannot be used, by their reasons."""
    for reason in dict.fromkeys(found.unused.values()):
        names = [name for name, why in found.unused.items() if why == reason]
        why, _, fix = reason.removeprefix("cannot be read: ").partition(". ")
        what = f"{counted(len(names), 'file')} cannot be used: {listed(names)} ({why})."
        yield Problem("warning", what, f"{fix}.")


def exposure(looks: dict[str, Look]) -> Iterator[Problem]:
    luminances = np.array([look.luminance for look in looks.values()])
    levels = np.log2(np.maximum(luminances, 1e-3))
    for sign, how in ((-1, "darker"), (+1, "brighter")):
        if names := sorted(outliers(list(looks), levels, LEAST_EXPOSURE, sign)):
            yield Problem(
                "warning",
                f"{are(names)} much {how} than the rest: {listed(names)}.",
                "Lock exposure and white balance, or leave these out.",
                tuple(names),
            )
    if np.median(luminances) < DARK:
        yield Problem("warning", "The photos are dark, so noise will be learned.", "Add light.")
    if white := sorted(name for name, look in looks.items() if look.clipped > MUCH_WHITE):
        what = f"{are(white)} white over more than {MUCH_WHITE:.0%} of their area: {listed(white)}."
        fix = "Expose for the bright parts, unless that is a white backdrop."
        yield Problem("warning", what, fix, tuple(white))


def blur(looks: dict[str, Look]) -> Iterator[Problem]:
    if names := sorted(blurred(looks)):
        yield Problem(
            "warning",
            f"{are(names)} blurred, compared with the rest: {listed(names)}.",
            "Leave them out, or take them again: stop before each photo, with a short exposure.",
            tuple(names),
        )


def are(names: list[str]) -> str:
    """Returns the subject and verb of a sentence, "1 photo is" or "2 photos are"."""
    return f"{counted(len(names))} {'is' if len(names) == 1 else 'are'}"


def masks(found: Examination) -> Iterator[Problem]:
    if bad := found.bad_masks:
        name, reason = next(iter(bad.items()))
        why = reason.removeprefix(f"{name}: ").removesuffix(".")
        what = f"{counted(len(bad), 'mask')} cannot be used: {listed(bad)} ({why})."
        fix = "Training stops at them: make them again, or delete them."
        yield Problem("error", what, fix, photos_of(found, bad))
    if hidden := sorted(name for name, shown in found.coverage.items() if shown < MOSTLY_HIDDEN):
        leave, their = ("leaves", "its") if len(hidden) == 1 else ("leave", "their")
        least = f"{MOSTLY_HIDDEN:.0%} of {their} photo"
        yield Problem(
            "warning",
            f"{counted(len(hidden), 'mask')} {leave} less than {least}: {listed(hidden)}.",
            "White counts and black does not: invert the masks if they are the other way round.",
            photos_of(found, hidden),
        )


def photos_of(found: Examination, views: Iterable[str]) -> tuple[str, ...]:
    """Returns the names of the photos that views with these names show."""
    named = {view.name: view.photo for view in found.dataset.views} if found.dataset else {}
    return tuple(dict.fromkeys(named[name] for name in views))


def points(found: Examination) -> Iterator[Problem]:
    if found.dataset is None:
        return
    count = len(found.dataset.points)
    if count == 0:
        yield Problem("warning", "There are no points to start from.", f"{TRIANGULATED}.")
    elif count < FEW_POINTS:
        yield Problem(
            "warning",
            f"Only {count} points to start from.",
            "Find more with detail high of splatax reconstruct, or start with init random of splatax train.",
        )


def memory(found: Examination) -> Iterator[Problem]:
    if found.memory and found.available and found.memory >= found.available:
        needed, free = found.memory / 1e9, found.available / 1e9
        yield Problem(
            "error",
            f"Training needs about {needed:.1f} GB, but {free:.1f} GB are free here.",
            f"Shrink the photos (downscale), or use fewer Gaussians (max_gaussians {found.gaussians // 4}).",
        )
