"""A run whose number of steps changes keeps the fractions of its recipe's schedule."""

import numpy as np
import pytest

import splatax as sx
from splatax.training.recipes import ShSchedule, default
from splatax.training.resolution import Resolution
from splatax.training.schedule import Schedule

RECIPE = default(steps=400, max_gaussians=1000)


def test_a_run_that_keeps_its_steps_follows_its_recipe():
    schedule = Schedule(400, 400, RECIPE.resolution)
    assert [schedule.place(step) for step in range(401)] == list(range(401))
    due = [step for step in range(1, 401) if RECIPE.density.due(step)]
    assert [step for step in range(1, 401) if schedule.refinement(step, RECIPE.density)] == due


@pytest.mark.slow
@pytest.mark.parametrize("total", [173, 200, 399, 401, 950])
def test_no_refinement_is_lost_or_made_twice_in_a_run_of_another_length(total):
    schedule = Schedule(400, total, RECIPE.resolution)
    made = [place for step in range(1, total + 1) if (place := schedule.refinement(step, RECIPE.density))]
    assert made == [step for step in range(1, 401) if RECIPE.density.due(step)]


def test_photos_get_full_size_halfway_through_a_run_that_was_shortened():
    schedule = Schedule(400, 400, Resolution(((200, 2),)))
    schedule.total = 220
    sizes = [schedule.divisor(step, (100, 100)) for step in range(1, 221)]
    assert sizes == [2] * 110 + [1] * 110


@pytest.mark.slow
@pytest.mark.parametrize("total", [24, 40, 200])
def test_bands_of_harmonics_open_at_their_fraction_of_a_run_of_any_length(total):
    dataset = sx.demo_dataset(photos=2, width=48, height=36)
    recipe = default(steps=40, max_gaussians=2_000)  # band l opens after l twentieths
    learned = {}
    for progress in sx.optimize(dataset, recipe, pace={1: total}.get):
        if progress.step > total / 4:
            break
        bands = [np.any(progress.padded.sh[:, l * l : (l + 1) ** 2]) for l in range(4)]
        learned |= {l: progress.step for l in range(4) if bands[l] and l not in learned}
    # A step learns what was open before it.
    assert {l: learned.get(l) for l in (1, 2, 3)} == {l: -(-l * total // 20) + 1 for l in (1, 2, 3)}


def test_the_same_bands_are_open_in_a_run_that_keeps_its_steps_as_by_whole_numbers():
    for steps in (17, 400, 1999, 30_000):
        openings = ShSchedule(every=max(steps // 20, 1)).openings(steps)
        made = np.arange(min(steps, 8000), dtype=np.int32)
        bands = (openings[None, :] <= (made.astype(np.float32) / np.float32(steps))[:, None]).sum(axis=1)
        assert (bands == np.minimum(made // max(steps // 20, 1), 4) + 1).all()


@pytest.mark.slow
def test_a_run_that_is_shortened_and_stopped_there_resumes_to_the_same_scene():
    dataset = sx.demo_dataset(photos=4, width=48, height=36)
    recipe = default(steps=40, max_gaussians=4_000)
    pace = {8: 24, 12: 20}.get
    *_, whole = sx.optimize(dataset, recipe, pace=pace)
    assert whole.total == whole.step == 20
    assert whole.count == 4_000  # grown to the end, although the recipe's growth ends at its 13th step of 40
    stopped = next(p for p in sx.optimize(dataset, recipe, pace=pace) if p.step == 8)
    *_, resumed = sx.optimize(dataset, recipe, stopped.state, pace)
    assert (resumed.gaussians.means == whole.gaussians.means).all()
