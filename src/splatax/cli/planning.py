"""The numbers of steps and Gaussians of a run, from its budget, its memory and the speed of the machine."""

from dataclasses import replace

import jax

import splatax as sx
from splatax.cli.options import flag
from splatax.cli.output import say
from splatax.cli.preparing import loaded
from splatax.cli.settings import Settings
from splatax.dataset import photos_in
from splatax.errors import InputError
from splatax.io.datasets.photos import counted
from splatax.runs.budget import MOST_VISITS, bounds_of, duration, measured, plan
from splatax.runs.clock import Expected
from splatax.runs.planning import Deadline, Room, gaussians_here, smaller_photos
from splatax.training.recipes import MOST, PRESETS, detail_of, most_for, room_for, steps_for


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
    most = most_gaussians(settings, dataset, room)
    if settings.seconds is not None:
        return planned_by_time(settings, dataset, room, most, deadline)
    fits = most == settings.most(dataset)
    return settings if fits else replace(settings, max_gaussians=most), dataset, None


def most_gaussians(settings: Settings, dataset: sx.Dataset, room: Room) -> int:
    """Returns the upper limit of the number of Gaussians.

    Prints if the capture has detail for more, or if the scene starts with more than were asked for.

    Raises:
        InputError: if more are asked for than there is room for.
    """
    if settings.max_gaussians != "auto":
        if settings.max_gaussians > room.gaussians:
            raise InputError(too_many(settings, dataset, room))
        first = settings.to_recipe(dataset).initialization.number(dataset)
        if first > settings.max_gaussians:
            say(
                f"the scene starts with about {first:,} Gaussians, more than {flag('max_gaussians')} "
                f"{settings.max_gaussians:,}, so it does not grow"
            )
        return settings.max_gaussians
    most = int(min(settings.most(dataset), room.gaussians))
    if most > MOST:
        most = int(max(min(most, gaussians_here(dataset, *drawn_here(settings.views))), MOST))
    if limited := limited_detail(settings, dataset, most):
        say(limited)
    return most


def too_many(settings: Settings, dataset: sx.Dataset, room: Room) -> str:
    """Returns the message about a number of Gaussians for which there is no room."""
    limit = f"{flag('memory')} {settings.memory} has room for {room.gaussians:,}"
    if dataset.block is None:
        asked = f"{flag('max_gaussians')} {settings.max_gaussians}"
        return f"{asked}: {limit}. Give more memory, or ask for fewer."
    around = len(dataset.block.context)
    return (
        f"Block {settings.block} grows to {settings.max_gaussians:,} Gaussians, with {around:,} fixed ones "
        f"around them: {limit}. Give more memory, or plan smaller blocks."
    )


def drawn_here(views: int) -> tuple[int, int]:
    """Returns the number of photos of a step that this process draws, of all `views`, and of its devices."""
    return -(-views // jax.process_count()), jax.local_device_count()


def planned_by_time(
    settings: Settings, dataset: sx.Dataset, room: Room, most: int, deadline: Deadline | None
) -> tuple[Settings, sx.Dataset, Expected]:
    """Returns settings, capture and costs of a plan that ends in time; see `planned`.

    If there is time for few steps only, the photos shrink, and the plan is made again for these.
    """
    say("measuring the speed of this machine ...")
    camera, recipe = dataset.train[0].camera, settings.to_recipe(dataset)
    costs = measured((camera.width, camera.height), recipe, camera.lens)
    if deadline:
        settings = replace(settings, budget=f"{deadline.left(dataset):.0f}s")
    assert settings.seconds
    first = recipe.initialization.number(dataset)
    asked = None if settings.max_gaussians == "auto" else settings.max_gaussians
    bounds = bounds_of(len(dataset.train), most, room.gaussians)
    chosen = plan(costs, settings.seconds, first, bounds, asked)
    milliseconds = 1e3 * costs.fine.step(chosen.max_gaussians)
    seconds = settings.seconds
    if chosen.steps == bounds.steps:
        seconds = min(costs.run(chosen.steps, first, chosen.max_gaussians), seconds)
        say(
            f"more than {MOST_VISITS} steps for each photo over-fit, so the run ends before its time. "
            "Make more: --steps"
        )
    say(
        f"plan: {chosen.steps:,} steps, {chosen.max_gaussians:,} Gaussians, {duration(seconds)} "
        f"(final steps about {milliseconds:.0f} ms each)"
    )
    if settings.downscale == "auto":
        smaller = smaller_photos(lambda divisor: loaded(settings, divisor), dataset, chosen.steps)
        if smaller is not None:
            downscale, dataset = smaller
            say(f"too few steps for photos of this size: --downscale {downscale}")
            settings = replace(settings, downscale=downscale)
            return planned_by_time(settings, dataset, room, most_gaussians(settings, dataset, room), deadline)
    settings = replace(settings, steps=chosen.steps, max_gaussians=chosen.max_gaussians)
    return settings, dataset, Expected(costs, first, chosen.max_gaussians)


def with_default_steps(settings: Settings, dataset: sx.Dataset) -> Settings:
    """Returns settings with the default number of steps, and prints it."""
    seen, choose = steps_for(dataset), "Choose another number: --steps"
    steps = -(-seen // settings.views)
    if settings.views > 1:
        say(f"{steps:,} steps of {counted(settings.views)}, {seen:,} photos in all. {choose}")
    else:
        count = photos_in(dataset.train)
        say(f"{steps:,} steps, {steps // count:,} for each of {counted(count)}. {choose}")
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
