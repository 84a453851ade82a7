"""Runs that are planned for a time."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from splatax.runs.budget import (
    FEWEST_STEPS,
    MOST_VISITS,
    ROUND,
    Bounds,
    Cost,
    Costs,
    coarse_size,
    longest_run,
    measured,
    parse_seconds,
    plan,
)
from splatax.runs.clock import Changes, Clock, Expected
from splatax.training.geometry import Surfaces
from splatax.training.recipes import Objective, Recipe
from splatax.training.resolution import Resolution

FAST = Costs(Cost(0.004, 1e-7), Cost(0.010, 2e-7))
SLOW = Costs(Cost(0.010, 5e-7), Cost(0.020, 8e-7))


def test_times_are_read_with_their_units():
    assert [parse_seconds(text) for text in ("90s", "5min", "1.5 h", "2m")] == [90, 300, 5400, 120]


@pytest.mark.parametrize("text", ["", "5", "min", "-3s", "0s", "1 fortnight"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="a time such as 90s"):
        parse_seconds(text)


@pytest.mark.parametrize("seconds", [30, 300, 3600])
@pytest.mark.parametrize("costs", [FAST, SLOW])
def test_a_plan_takes_the_time_that_it_is_given(costs, seconds):
    chosen = plan(costs, seconds, first=10_000, bounds=Bounds(100_000))
    spent = costs.run(chosen.steps, 10_000, chosen.max_gaussians)
    one_more = costs.run(chosen.steps + 1, 10_000, chosen.max_gaussians + ROUND)
    assert spent <= seconds < one_more


@pytest.mark.parametrize("costs", [SLOW, replace(SLOW, plain=FAST, after=0.3)])
def test_a_run_takes_as_long_as_all_of_its_steps(costs):
    steps = np.arange(3000) / 3000
    counts = 1000 * 64 ** np.minimum(3 * steps, 1)  # by equal factors in the first third

    def cost(done):
        if costs.plain and done < 0.3:
            return FAST.coarse
        return SLOW.coarse if done < 0.5 else SLOW.fine

    seconds = np.array([cost(done).step(count) for done, count in zip(steps, counts, strict=True)])
    whole = pytest.approx(seconds.sum(), rel=0.01)
    assert 3000 * costs.rest(0.0, 1000, 64_000) == whole
    assert costs.run(6000, 1000, 64_000) - costs.run(3000, 1000, 64_000) == whole
    assert 3000 * costs.rest(0.4, 1000, 64_000) == pytest.approx(seconds[1200:].sum(), rel=0.01)


def test_more_time_is_more_steps_and_more_gaussians_up_to_what_there_is_room_for():
    plans = [plan(SLOW, seconds, first=10_000, bounds=Bounds(100_000)) for seconds in (20, 60, 600)]
    assert plans[0].steps < plans[1].steps < plans[2].steps
    assert plans[0].max_gaussians < plans[1].max_gaussians <= plans[2].max_gaussians == 100_000


def test_a_run_of_many_steps_goes_on_to_six_gaussians_a_step_up_to_the_limit_of_any_run():
    short, long, longest = (
        plan(SLOW, seconds, 500, bounds=Bounds(9_000, ample=18_000)) for seconds in (15, 70, 600)
    )
    assert short.max_gaussians == 9_000 > 6 * short.steps
    assert long.max_gaussians == 6 * long.steps // ROUND * ROUND > 9_000
    assert longest.max_gaussians == 18_000 < 6 * longest.steps
    assert plan(SLOW, 600, 500, bounds=Bounds(9_000)).max_gaussians == 9_000


def test_a_run_ends_before_its_time_if_more_steps_would_over_fit():
    few, many = longest_run(20), longest_run(10_000)
    assert plan(FAST, 3600, 500, bounds=Bounds(9_000, steps=few)).steps == few == 20 * MOST_VISITS
    assert plan(SLOW, 60, 500, bounds=Bounds(9_000, steps=many)) == plan(SLOW, 60, 500, bounds=Bounds(9_000))
    assert longest_run(0) == FEWEST_STEPS


@pytest.mark.parametrize("planned", [False, True])
def test_the_clock_does_not_extend_a_run_beyond_the_steps_that_over_fit(planned):
    expected = Expected(SLOW, 10_000, 50_000) if planned else None
    clock = Clock(seconds=600.0, expected=expected, longest=1_000)
    for step, seconds in ((600, 1.0), (700, 1.1), (800, 1.2)):  # far faster than planned
        clock.note(step, 1_000, seconds)
    assert all(total <= 1_000 for _, total in clock.made)


def test_a_number_of_gaussians_that_is_given_is_kept():
    assert plan(SLOW, 60, first=10_000, bounds=Bounds(100_000), most=30_000).max_gaussians == 30_000


def test_too_little_time_still_makes_some_steps():
    assert plan(SLOW, 0.1, first=10_000, bounds=Bounds(100_000)).steps == FEWEST_STEPS


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_a_run_ends_in_time_whatever_the_plan_took_the_speed_for(factor):
    clock = Clock(seconds=60.0)
    total, seconds, step = 1000, 0.0, 0
    while step < total:
        step += 1
        done = step / total
        seconds += 0.04 * factor * (min(3 * done, 1) * 0.8 + 0.2)  # dearer while the scene grows
        seconds += 0.05 * factor * (done > 0.5)  # and with larger photos
        if clock.due(step, total):
            clock.note(step, total, seconds)
        total = clock(step) or total
    assert seconds == pytest.approx(60.0, rel=0.1)


@pytest.mark.parametrize(
    "busy",
    [
        lambda seconds: 0.6,
        lambda seconds: 1.0,
        lambda seconds: 1.8,
        lambda seconds: 1.0 if seconds < 25 else 2.5,
        lambda seconds: 2.5 if seconds < 25 else 1.0,
        lambda seconds: 1.0 + (seconds % 10 > 5),
    ],
    ids=["faster", "as planned", "slower", "slower later", "faster later", "in bursts"],
)
def test_a_planned_run_keeps_its_time_and_its_full_size_half_on_a_busy_machine(busy):
    first, budget = 10_000, 60.0
    chosen = plan(SLOW, budget, first, bounds=Bounds(100_000))
    clock = Clock(seconds=budget, expected=Expected(SLOW, first, chosen.max_gaussians))
    total, seconds, step, full_size = chosen.steps, 0.0, 0, 0
    while step < total:
        step += 1
        done = step / total
        count = first * (chosen.max_gaussians / first) ** min(3 * done, 1)
        full_size += done > 0.5
        seconds += busy(seconds) * (SLOW.fine if done > 0.5 else SLOW.coarse).step(count)
        if clock.due(step, total):
            clock.note(step, total, seconds)
        total = clock(step) or total
    assert seconds == pytest.approx(budget, rel=0.06)
    assert full_size / total > 0.3  # of 0.5 as planned: the steps with photos of full size are not cut off


def test_what_is_done_between_steps_counts_where_the_whole_command_is_limited():
    first, limit, picture = 10_000, 60.0, 0.4  # seconds for a picture, which is no time of training
    chosen = plan(SLOW, limit, first, bounds=Bounds(100_000))
    pictures = 0.0
    clock = Clock(seconds=limit, expected=Expected(SLOW, first, chosen.max_gaussians))
    clock.left = lambda: limit - seconds - pictures
    total, seconds, step = chosen.steps, 0.0, 0
    while step < total:
        step += 1
        done = step / total
        count = first * (chosen.max_gaussians / first) ** min(3 * done, 1)
        seconds += (SLOW.fine if done > 0.5 else SLOW.coarse).step(count)
        if clock.due(step, total):
            pictures += picture
            clock.note(step, total, seconds)
        total = clock(step) or total
    assert pictures > 5
    assert seconds + pictures == pytest.approx(limit, rel=0.06)


def test_a_run_is_not_shortened_to_hardly_a_picture():
    clock = Clock(seconds=10.0)
    clock.note(100, 500, seconds=50.0)
    assert clock(100) == FEWEST_STEPS


def test_changes_repeat_without_a_clock():
    changes = Changes([(3, 8), (5, 6)])
    assert [changes(step) for step in range(1, 7)] == [None, None, 8, None, 6, None]
    assert not changes.due(3, 8)


def test_steps_of_this_machine_are_measured():
    with jax.numpy_dtype_promotion("standard"):  # as optax needs it
        costs = measured((40, 30), Recipe(resolution=Resolution(((1, 2),))))
    for cost in (costs.coarse, costs.fine):
        assert cost.base > 0
        assert cost.each >= 0


def test_steps_before_the_penalties_on_geometry_are_measured_without_them(monkeypatch):
    plain, late = Cost(0.004, 1e-7), Cost(0.010, 2e-7)

    def cost_of(size, recipe, lens):
        return late if recipe.objective.geometry.outputs else plain

    monkeypatch.setattr("splatax.runs.budget.cost_of", cost_of)
    recipe = Recipe(objective=Objective(geometry=Surfaces(after=0.25)))
    assert measured((40, 30), recipe) == Costs(late, late, Costs(plain, plain), after=0.25)
    assert measured((40, 30), Recipe()) == Costs(plain, plain)


def test_photos_are_smaller_at_first_unless_they_would_be_too_small():
    recipe = Recipe(resolution=Resolution(((1, 2),), smallest=100))
    assert coarse_size((504, 378), recipe) == (252, 189)
    assert coarse_size((270, 198), recipe) == (270, 198)
    assert coarse_size((504, 378), Recipe()) == (504, 378)
