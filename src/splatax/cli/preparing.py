"""The capture and the plan of a run, from its options, its photos and the speed of the machine."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import splatax as sx
from splatax.blocks.parts import part_of
from splatax.cli.options import flag, load_scene
from splatax.cli.output import say
from splatax.cli.settings import Settings
from splatax.cli.stages import Stages
from splatax.dataset import View, photos_by, photos_in, without
from splatax.errors import InputError
from splatax.inspection.decisions import Findings, look_first
from splatax.io.datasets.photos import counted, listed
from splatax.io.datasets.points import read_points, write_points
from splatax.reconstruction import bundle, triangulation
from splatax.reconstruction.calibration import corrected
from splatax.runs.budget import Expected, duration, measured, plan
from splatax.runs.cameras import with_cameras, write_cameras
from splatax.runs.planning import Deadline, Room, gaussians_here, smaller_photos
from splatax.splits import Listed, listed_in
from splatax.training.camera_refinement import check_lenses
from splatax.training.initialize import Discs, InFrusta, focus_distance
from splatax.training.recipes import MOST, PRESETS, detail_of, most_for, room_for, steps_for

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

    Adjusts cameras if requested, finds points if the capture has none, leaves out blurred and repeated
    photos, and compensates for uneven exposure. The settings that are returned record the decisions, so a run
    that is resumed or repeated takes them over.

    Args:
        settings: of the run; only what they leave open is decided.
        dataset: the capture.
        out: folder of the run.
    """
    if settings.city:
        return settings, dataset  # all is decided for all blocks at once
    if settings.refine != "none":
        check_lenses(settings.refine, dataset.train)
    if settings.adjust_cameras != "none":
        settings, dataset = with_adjusted_cameras(settings, dataset, out)
    if settings.init == "sfm" and not len(dataset.points):
        path = found_points(settings.scene, dataset.train, out, settings.seed)
        if path is None:
            settings = replace(settings, init="random")
        else:
            settings = replace(settings, points=path)
            dataset = replace(dataset, points=read_points(path))
    if settings.init == "random":
        say(random_start(dataset, settings))
    if "auto" not in (settings.leave_out, settings.appearance):
        return settings, dataset
    findings = look_first(dataset)
    if settings.leave_out == "auto":
        names, lines = spared_by(findings)
        if len(names) > MOST_LEFT_OUT * photos_in(dataset.train):
            names, lines = [], []
            say(
                "most photos are blurred or repeat another, so all are used. Leave some out: --leave-out LIST"
            )
        for line in lines:
            say(f"{line}. Use all photos: --leave-out none")
        settings = replace(settings, leave_out="".join(f"{name}\n" for name in names) or "none")
        dataset = without(dataset, names)
    if settings.appearance == "auto":
        if findings.uneven:
            say(
                f"exposure differs between photos by {findings.exposure:.2f} stops (standard deviation), so "
                "it is compensated for. Turn that off: --appearance none"
            )
        settings = replace(settings, appearance="exposure" if findings.uneven else "none")
    return settings, dataset


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


def planned(
    settings: Settings, dataset: sx.Dataset, room: Room, deadline: Deadline | None = None
) -> tuple[Settings, sx.Dataset, Expected | None]:
    """Returns settings and capture so that they fit into the budget and the memory, and the plan's costs.

    The numbers of steps and Gaussians change, and for short budgets the size of photos.

    Args:
        settings: of the run.
        dataset: the capture.
        room: the memory of the run.
        deadline: of the whole command; the budget becomes what is left until then.

    Raises:
        InputError: if more Gaussians are asked for than there is room for.
    """
    asked = None if settings.max_gaussians == "auto" else settings.max_gaussians
    if asked and asked > room.gaussians:
        raise InputError(
            f"{flag('max_gaussians')} {asked}: {flag('memory')} {settings.memory} has room for "
            f"{room.gaussians:,}. Give more memory, or ask for fewer."
        )
    most = settings.most(dataset)
    fit = int(min(most, room.gaussians))
    if asked is None and fit > MOST:
        fit = int(max(min(fit, gaussians_here(dataset)), MOST))
    if asked is None and (limited := limited_detail(settings, dataset, fit)):
        say(limited)
    if settings.seconds is None:
        return (settings if fit == most else replace(settings, max_gaussians=fit)), dataset, None
    say("measuring the speed of this machine ...")
    camera, recipe = dataset.train[0].camera, settings.to_recipe(dataset)
    costs = measured((camera.width, camera.height), recipe, camera.lens)
    if deadline:
        settings = replace(settings, budget=f"{deadline.left(dataset):.0f}s")
    assert settings.seconds
    first = recipe.initialization.number(dataset)
    chosen = plan(costs, settings.seconds, first, fit, asked)
    milliseconds = 1e3 * costs.fine.step(chosen.max_gaussians)
    say(
        f"plan: {chosen.steps:,} steps, {chosen.max_gaussians:,} Gaussians, {duration(settings.seconds)} "
        f"(final steps about {milliseconds:.0f} ms each)"
    )
    smaller = None
    if settings.downscale == "auto":
        smaller = smaller_photos(lambda divisor: loaded(settings, divisor), dataset, chosen.steps)
    if smaller is None:
        most = chosen.max_gaussians
        return (
            replace(settings, steps=chosen.steps, max_gaussians=most),
            dataset,
            Expected(costs, first, most),
        )
    downscale, dataset = smaller
    say(f"too few steps for photos of this size: --downscale {downscale}")
    return planned(replace(settings, downscale=downscale), dataset, room, deadline)


def with_default_steps(settings: Settings, dataset: sx.Dataset) -> Settings:
    """Returns settings with the default number of steps, and prints it with several views or above 30,000."""
    seen, choose = steps_for(dataset), "Choose another number: --steps"
    steps = -(-seen // settings.views)
    if settings.views > 1:
        say(f"{steps:,} steps of {counted(settings.views)}, {seen:,} photos in all. {choose}")
    elif steps > settings.steps:
        count = photos_in(dataset.train)
        say(f"{steps:,} steps, {steps // count} for each of {counted(count)}. {choose}")
    return replace(settings, steps=steps)


def limited_detail(settings: Settings, dataset: sx.Dataset, fit: int) -> str:
    """Returns a line for captures with detail for more Gaussians than the run may have; empty for others."""
    detail = detail_of(dataset)
    if PRESETS[settings.recipe].max_gaussians is not room_for or fit >= detail:
        return ""
    way_out = "Choose another number: --max-gaussians"
    if fit < most_for(dataset):
        way_out = "More need more memory" + (f" than --memory {settings.memory}" if settings.memory else "")
    return f"at most {fit:,} Gaussians, though the photos may have detail for {detail:,}. {way_out}"


def spared_by(findings: Findings) -> tuple[list[str], list[str]]:
    """Returns the photos to leave out of training, and why, as lines."""
    lines = []
    repeated = sorted(findings.repeated)
    blurred = [name for name in findings.blurred if name not in repeated]
    if blurred:
        lines.append(f"left out of training, blurred compared with the rest: {listed(blurred)}")
    if repeated:
        pairs = (f"{name} (as {findings.repeated[name]})" for name in repeated)
        lines.append(f"left out of training, the same photo as another: {listed(pairs)}")
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
