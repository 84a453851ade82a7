"""The capture of a run, from its options and its photos."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import splatax as sx
from splatax.blocks.parts import part_of
from splatax.cli.options import load_scene
from splatax.cli.output import say
from splatax.cli.settings import Settings
from splatax.cli.stages import Stages
from splatax.dataset import View, photos_by, photos_in, without
from splatax.inspection.decisions import FEW, LARGEST_FRACTION, LOOKING, Findings, look_first
from splatax.inspection.examination import surveyed
from splatax.inspection.problems import problems_of_cameras, problems_of_points
from splatax.io.datasets.photos import counted, listed
from splatax.io.datasets.points import read_points, write_points
from splatax.reconstruction import bundle, triangulation
from splatax.reconstruction.calibration import corrected
from splatax.runs.cameras import with_cameras, write_cameras
from splatax.splits import Listed, listed_in
from splatax.training.camera_refinement import check_lenses
from splatax.training.initialize import Discs, InFrusta, focus_distance

MOST_LEFT_OUT = 0.5  # of the training photos that are left out
POINTS = "points.ply"  # in the folder of a run that had to find its points
CAMERAS = "cameras.json"  # in the folder of a run that adjusted its cameras
FEWEST_POINTS = 100  # from which triangulated points are a better start than random ones


def loaded(settings: Settings, downscale: int | None = None) -> sx.Dataset:
    """Loads the capture of a run, with the held-out photos, photos to leave out and points of its settings.

    Args:
        settings: of the run.
        downscale: factor by which photos are shrunk, instead of that of the settings.

    Raises:
        InputError: if the settings name a photo that is not there.
    """
    assert settings.scene
    dataset = load_scene(
        settings.scene,
        downscale or settings.downscale,
        hold_out=settings.hold_out,
        undistort=settings.undistort,
    )
    if settings.leave_out not in ("auto", "none"):
        listed_ones = photos_by(Listed(listed_in(settings.leave_out)), dataset.views)
        spared = listed_ones & {view.photo for view in dataset.train}
        dataset = without(dataset, spared)
        note = f"{counted(len(spared))} left out of training: {listed(sorted(spared))}"
        dataset = replace(dataset, notes=(*dataset.notes, note))
    if settings.points:
        points = read_points(settings.points)
        note = f"{len(points):,} points from {settings.points.name}"
        dataset = replace(dataset, points=points, notes=(*dataset.notes, note))
    if settings.cameras:
        dataset = with_cameras(dataset, settings.cameras)
        note = f"adjusted cameras from {settings.cameras.name}"
        dataset = replace(dataset, notes=(*dataset.notes, note))
    return part_of(dataset, settings.city, settings.block) if settings.city else dataset


def prepared(settings: Settings, dataset: sx.Dataset, out: Path) -> tuple[Settings, sx.Dataset]:
    """Examines the photos, and returns settings and capture; prints each decision in one line.

    Warns of problems of the capture that are known without its photos. Adjusts cameras if requested, finds
    points if the capture has none, leaves out blurred and repeated photos, and compensates for uneven
    exposure. The settings that are returned record the decisions, so a run that is resumed or repeated takes
    them over.

    Args:
        settings: of the run; only what they leave open is decided.
        dataset: the capture.
        out: folder of the run.
    """
    if settings.city:
        return settings, dataset  # all is decided for all blocks at once
    if settings.judged_by is None:  # else the run that judges this one has warned of the same photos
        warn_of_problems(settings, dataset)
    if settings.refine != "none":
        check_lenses(settings.refine, dataset.train)
    if settings.adjust_cameras != "none":
        settings, dataset = with_adjusted_cameras(settings, dataset, out)
    if settings.init == "sfm" and not len(dataset.points):
        settings, dataset = with_found_points(settings, dataset, out)
    if settings.init == "random":
        say(random_start(dataset, settings))
    if "auto" not in (settings.leave_out, settings.appearance):
        return settings, dataset
    findings = look_first(dataset)
    if findings.seen < findings.photos:
        say(
            f"examined {findings.seen} of {counted(findings.photos)} in {LOOKING:.0f} s: the others stay in "
            "training, and exposure is judged without them. Decide yourself: --leave-out LIST, --appearance"
        )
    if settings.leave_out == "auto":
        settings, dataset = without_spared(settings, dataset, findings)
    if settings.appearance == "auto":
        settings = with_exposure(settings, findings)
    return settings, dataset


def warn_of_problems(settings: Settings, dataset: sx.Dataset) -> None:
    """Prints a warning for each problem of the capture that is known without a look at its photos."""
    assert settings.scene
    known = surveyed(settings.scene, dataset)
    problems = problems_of_cameras(known)
    if settings.init == "sfm" and len(dataset.points):
        problems += problems_of_points(known)
    for problem in problems:
        say(f"warning: {problem.what} {problem.fix}")


def with_adjusted_cameras(settings: Settings, dataset: sx.Dataset, out: Path) -> tuple[Settings, sx.Dataset]:
    """Adjusts the cameras of training photos, writes them to OUT/cameras.json, and prints what changed.

    Held-out photos get the lenses that were found for training photos, and keep their poses.

    Returns:
        Settings that name the file and the capture with the adjusted cameras; both as given where adjusting
        does not help.
    """
    with Stages(bundle.STAGES) as stages:
        outcome = bundle.adjusted_cameras(
            dataset.train, settings.adjust_cameras, seed=settings.seed, watch=stages.show
        )
    say(str(outcome))
    if not outcome.helps:
        return settings, dataset
    held_out = outcome.lenses_of(dataset.test)
    write_cameras(out / CAMERAS, outcome.views, {**outcome.lenses, **held_out})
    adjusted = replace(
        dataset,
        train=outcome.views,
        test=corrected(dataset.test, held_out),
        notes=(*dataset.notes, str(outcome)),
    )
    return replace(settings, cameras=out.absolute() / CAMERAS), adjusted


def with_found_points(settings: Settings, dataset: sx.Dataset, out: Path) -> tuple[Settings, sx.Dataset]:
    """Returns settings and capture with points that were found in the photos, or that start at random."""
    path = found_points(settings.scene, dataset.train, out, settings.seed)
    if path is None:
        return replace(settings, init="random"), dataset
    return replace(settings, points=path), replace(dataset, points=read_points(path))


def without_spared(
    settings: Settings, dataset: sx.Dataset, findings: Findings
) -> tuple[Settings, sx.Dataset]:
    """Returns settings and capture without blurred and repeated photos, unless these are most photos."""
    names, lines = spared_by(findings)
    if len(names) > MOST_LEFT_OUT * photos_in(dataset.train):
        names, lines = [], []
        say("most photos are blurred or repeat another, so all are used. Leave some out: --leave-out LIST")
    for line in lines:
        say(line)
    leave_out = "".join(f"{name}\n" for name in names) or "none"
    return replace(settings, leave_out=leave_out), without(dataset, names)


def with_exposure(settings: Settings, findings: Findings) -> Settings:
    """Returns settings that compensate for uneven exposure if there is any."""
    if not findings.uneven:
        return replace(settings, appearance="none")
    say(
        f"exposure differs between photos by {findings.exposure:.2f} stops (standard deviation), so it is "
        "compensated for. Turn that off: --appearance none"
    )
    return replace(settings, appearance="exposure")


def spared_by(findings: Findings) -> tuple[list[str], list[str]]:
    """Returns the photos to leave out of training, and lines about these and about blurred ones that stay."""
    lines, way_out = [], "Use all photos: --leave-out none"
    repeated = sorted(findings.repeated)
    blurred = [name for name in findings.blurred if name not in repeated]
    kept = [name for name in findings.kept if name not in repeated]
    if blurred:
        lines.append(f"left out of training, blurred compared with the rest: {listed(blurred)}. {way_out}")
    if repeated:
        pairs = (f"{name} (as {findings.repeated[name]})" for name in repeated)
        lines.append(f"left out of training, the same photo as another: {listed(pairs)}. {way_out}")
    if kept:
        lines.append(
            f"blurred compared with the rest, but used: {listed(kept)} (at most {LARGEST_FRACTION:.0%} are "
            f"left out, and none of {FEW} photos or fewer). Leave them out: --leave-out LIST"
        )
    return sorted([*blurred, *repeated]), lines


def found_points(scene: Path | None, views: Sequence[View], out: Path, seed: int) -> Path | None:
    """Triangulates points from photos with known cameras, and writes them to OUT/points.ply.

    Returns:
        The file; None if there are too few points to start from.
    """
    say(f"{scene}: cameras without points; finding points in {counted(len(views))}")
    with Stages(triangulation.STAGES) as stages:
        points = triangulation.triangulated(views, seed=seed, watch=stages.show)
    if len(points) < FEWEST_POINTS:
        say(f"only {counted_points(len(points))} found, at least {FEWEST_POINTS} are needed")
        return None
    write_points(out / POINTS, points)
    say(f"{counted_points(len(points))} found, written to {out / POINTS}")
    return out.absolute() / POINTS


def counted_points(number: int) -> str:
    """Returns a number of points in words."""
    return "1 point" if number == 1 else f"{number:,} points"


def random_start(dataset: sx.Dataset, settings: Settings) -> str:
    """Returns where random Gaussians begin, in words."""
    start = replace(settings, sky=False).initialization()
    start = start.start if isinstance(start, Discs) else start
    assert isinstance(start, InFrusta)
    distance = focus_distance([view.camera for view in dataset.train], dataset.extent)
    near, far = start.nearest * distance, start.farthest * distance
    return (
        f"starting from {start.count:,} random Gaussians in front of the cameras, {near:.3g} to {far:.3g} "
        "world units away"
    )
