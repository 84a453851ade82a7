"""A step of several views gives the same scene, bit for bit, on any number of devices and processes."""

import re
import socket
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import replace
from functools import cache, partial
from itertools import chain, count, islice
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose
from test_training import RECIPE, capture, run

import splatax as sx
from emitters import as_users_compile
from splatax import backends
from splatax.runs.scaling import bytes_exchanged
from splatax.training.density import NoDensityControl
from splatax.training.devices import BLOCK, Sharding, devices_for
from splatax.training.feed import FIRST, READERS, batch
from splatax.training.groups import grouped, steps_of
from splatax.training.loop import first_state
from splatax.training.optimizer import LearningRates, Optimizer
from splatax.training.recipes import ShSchedule, with_views
from splatax.training.step import compare
from splatax.training.travel import MOST, PIECES
from splatax.training.views import step_on_views

HERE = Path(__file__).parent
ENVIRONMENT = as_users_compile(PYTHONPATH=f"{HERE.parent}:{HERE}")
needs_cpu = pytest.mark.skipif(
    backends.why_unavailable("cpu") is not None, reason="only the native backend computes each row alone"
)


class Trained(NamedTuple):
    """What a run prints."""

    first: int
    last: int
    owners: int  # of living Gaussians, the fewest at any step
    digest: str  # of all arrays that a checkpoint holds
    loss: str

    @property
    def same(self):
        return self.last, self.digest, self.loss

    @property
    def has_grown(self):
        return self.last > self.first > 7 * BLOCK


def program(*arguments):
    return [sys.executable, str(HERE / "on_devices.py"), *arguments]


def results(output):
    """Results by number of devices; the collectives print between."""
    lines = re.findall(r"run (\d+) (\d+) (\d+) (\d+) (\w+) (\S+)", output)
    return {int(devices): Trained(*map(int, found[:3]), *found[3:]) for devices, *found in lines}


@cache
def printed(*arguments):
    return subprocess.run(
        program(*arguments), check=True, capture_output=True, text=True, env=ENVIRONMENT
    ).stdout


def trained(*arguments):
    return results(printed(*arguments))


@cache
def trained_by_two(*arguments):
    """What each of two processes with four devices prints."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    both = [
        subprocess.Popen(
            program(*arguments, "--host", port, "2", index),
            stdout=subprocess.PIPE,
            text=True,
            env=ENVIRONMENT,
        )
        for index in ("0", "1")
    ]
    outputs = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    return outputs


ON_EACH = ("default", "--devices", "1", "2", "4", "8")
PER_PHOTO = ("classic", "--per-photo")


@needs_cpu
@pytest.mark.slow
@pytest.mark.parametrize("arguments", [ON_EACH, (*PER_PHOTO, *ON_EACH[1:])])
def test_a_scene_that_all_devices_own_a_part_of_is_the_same_bits_on_1_2_4_and_8(arguments):
    found = trained(*arguments)
    assert {number: run.owners for number, run in found.items()} == {1: 1, 2: 2, 4: 4, 8: 8}
    assert found[8].has_grown, "density control must be part of the comparison"
    assert len({run.same for run in found.values()}) == 1


@needs_cpu
@pytest.mark.slow
def test_all_parts_of_a_recipe_together_have_the_same_bits_on_1_and_8_devices():
    """Penalties on depths, exposures, poses and weights of photos in one run."""
    found = trained("classic", "--per-photo", "--geometry", "--devices", "1", "8")
    assert found[8].owners == 8
    assert found[8].has_grown
    assert found[1].same == found[8].same


@pytest.mark.slow
@needs_cpu
def test_a_run_resumes_on_another_number_of_devices_with_the_same_bits():
    resumed = trained("default", "--resume", "--devices", "2", "8")
    assert trained(*ON_EACH)[8].same == resumed[8].same


@needs_cpu
@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["default", "classic"])
def test_rows_that_photos_do_not_show_stay_where_they_are_and_the_bits_are_the_same(recipe):
    arguments = (recipe, "--packed", "--apart", "--per-photo", "--devices", "1", "2", "8")
    shown = [float(word) for word in re.search(r"shown (.*)", printed(*arguments))[1].split()]
    assert max(shown) < MOST / PIECES, "a step that shows more sends all rows"
    assert min(shown) > 1 / PIECES, "a photo must need more than one piece"
    found = trained(*arguments)
    assert {number: run.owners for number, run in found.items()} == {1: 1, 2: 2, 8: 8}
    assert len({run.same for run in found.values()}) == 1


@needs_cpu
@pytest.mark.slow
def test_two_processes_that_send_only_what_photos_show_train_the_same_bits_as_one_that_sends_all():
    options = ("default", "--apart")
    ours, theirs = (results(output)[8] for output in trained_by_two(*options))
    assert ours.same == theirs.same == trained(*options, "--devices", "8")[8].same


@pytest.mark.slow
@needs_cpu
def test_a_step_exchanges_as_many_bytes_as_the_model_of_many_devices_counts():
    numbers = re.search(r"run 8 ([\d ]+)", printed("default", "--packed", "--bytes", "--devices", "8"))[1]
    always, there, back, piece_there, piece_back = map(int, numbers.split())
    flags = bytes_exchanged(16_384, 0.0)
    assert flags <= always < flags + 1024, "beside splats and cotangents, a few numbers travel"
    assert flags + there + back == bytes_exchanged(16_384, 0.6)
    assert flags + 2 * (piece_there + piece_back) == bytes_exchanged(16_384, 0.2)


@pytest.mark.slow
@needs_cpu
def test_density_control_holds_no_more_on_a_device_than_its_own_rows_and_a_few_of_others():
    output = printed("default", "--refinement", "--devices", "1", "8")
    alone, of_eight = (int(re.search(rf"run {number} (\d+)", output)[1]) for number in (1, 8))
    assert of_eight < alone / 8 + 8 * 2 * BLOCK * 4 * 59, "beside its rows, those of one exchange at most"


@needs_cpu
@pytest.mark.slow
@pytest.mark.parametrize("options", [("default",), PER_PHOTO])
def test_two_processes_of_four_devices_train_the_same_bits_as_one_of_eight(options):
    ours, theirs = (results(output)[8] for output in trained_by_two(*options))
    assert ours == theirs
    assert ours.owners == 4, "each process sees its own devices"
    assert ours.same == trained(*options, *ON_EACH[1:])[8].same


@needs_cpu
@pytest.mark.slow
def test_a_process_decodes_only_the_photos_that_its_devices_draw():
    """No photo is kept in memory, so each use of one is a read; some steps are read ahead."""
    steps, views, ahead = 8, 8, READERS
    groups = list(islice(grouped(["alike"] * 11, views, seed=0), steps + ahead))
    names = [view.name for view in capture(views=12).train]
    for index, output in enumerate(trained_by_two("default")):
        drawn = [[names[i] for i in group[4 * index : 4 * index + 4]] for group in groups]
        needed, most = (Counter(chain(*drawn[:until])) for until in (steps, None))
        read = Counter(re.search(r"read ((?:\d+\.png ?)+)", output)[1].split())
        assert needed <= read <= most


def test_training_on_several_views_a_step_learns():
    dataset = capture()
    recipe = with_views(RECIPE, 5)
    history = run(dataset, recipe)
    before = recipe.initialization(dataset, 1, 0)
    after = history[-1][3].gaussians
    assert history[-1][2] > 80
    assert sx.evaluate(after, dataset.test).psnr > sx.evaluate(before, dataset.test).psnr + 3


def test_one_view_a_step_trains_by_the_plain_program_on_a_device_that_is_named():
    dataset, recipe = capture(), replace(RECIPE, steps=25)
    programs = step_on_views._cache_size()
    named, unnamed = (
        list(sx.optimize(dataset, recipe, devices=devices))[-1].state for devices in (jax.devices()[:1], None)
    )
    assert step_on_views._cache_size() == programs
    scenes = (jax.tree.leaves(state.train.gaussians) for state in (named, unnamed))
    assert all(np.array_equal(one, other) for one, other in zip(*scenes, strict=True))


def test_a_step_on_several_views_follows_the_mean_of_their_gradients():
    dataset = capture(views=5)
    optimizer = Optimizer(rule=partial(optax.sgd, 1.0), rates=LearningRates(sh_rest=0.0, settled=1.0))
    density, sh = NoDensityControl(), ShSchedule(0)
    recipe = sx.Recipe(steps=1, views=4, optimizer=optimizer, density=density, sh=sh).on(backends.resolve())
    start = recipe.initialization(dataset, 0, 0)
    state = first_state(start, recipe, 1.0, 4)
    gradients = []
    for view in dataset.train:
        found = compare(state, batch(view.camera, view.pixels(), None, FIRST, 1), recipe, jax.random.key(0))
        gradients.append(found.pull_back(found.d_shown)[0])
    mean = jax.tree.map(lambda *leaves: sum(leaves) / 4, *gradients)
    (progress,) = sx.optimize(dataset, recipe)
    for name, rate in (("log_scales", 5e-3), ("opacity_logits", 0.05), ("sh", 2.5e-3)):
        moved = getattr(progress.gaussians, name) - getattr(start, name)
        expected = -rate * getattr(mean, name)
        assert_allclose(moved, expected, atol=3e-7)
        assert np.abs(expected).max() > 3e-6


def test_views_of_a_step_are_of_one_kind_and_all_are_used_equally_often():
    kinds = ["wide"] * 5 + ["tall"] * 3
    stream = grouped(kinds, 2, seed=0)
    groups = [next(stream) for _ in range(400)]
    assert all(kinds[a] == kinds[b] for a, b in groups)
    counts = np.bincount(np.concatenate(groups), minlength=8)
    assert counts.max() - counts.min() <= 1


def test_a_kind_with_fewer_views_than_a_step_waits_and_is_not_lost():
    stream = grouped(["wide"] * 4 + ["tall"], 2, seed=0)
    assert [4, 4] in [next(stream) for _ in range(8)]


def test_devices_that_do_not_divide_the_views_are_refused():
    with pytest.raises(ValueError, match="do not divide"):
        devices_for(3, jax.devices() * 2)


def test_larger_steps_are_longer_and_remember_squares_for_as_many_photos():
    recipe = sx.recipes.default(1000, max_gaussians=100)
    one, several = recipe.optimizer, with_views(recipe, 8).optimizer
    assert_allclose(several.rates.means, 8**0.85 * one.rates.means)
    assert several.rates.settled == one.rates.settled
    assert_allclose(several.rule.b2, 0.999**8)
    assert several.rule.b1 == one.rule.b1
    assert with_views(recipe, 1) == recipe

    sgd = replace(recipe, optimizer=replace(one, rule=partial(optax.sgd, 1.0)))
    assert with_views(sgd, 8).optimizer.rule is sgd.optimizer.rule


def test_photos_with_and_without_alpha_share_a_step():
    opaque, clear = capture(views=5), capture(views=5, alpha=True)
    mixed = sx.Dataset(opaque.train[:2] + clear.train[2:], opaque.test, opaque.points)
    recipe = with_views(sx.Recipe(steps=2, sh=ShSchedule(0)), 4)
    scenes = [sx.fit(dataset, recipe) for dataset in (opaque, mixed)]
    for ours, theirs in zip(*map(jax.tree.leaves, scenes), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)  # two programs


def test_photos_of_a_step_are_decoded_at_the_same_time(monkeypatch):
    """Photos wait for each other in pairs, so two threads must decode them."""
    monkeypatch.setattr("splatax.training.groups.cores", lambda: 2)
    meeting, numbers = threading.Barrier(2), count()

    def met(view):
        def pixels():
            if next(numbers) < 4:
                meeting.wait(timeout=60)
            return view.pixels()

        return replace(view, pixels=pixels)

    views, recipe = [met(view) for view in capture(views=5).train], with_views(RECIPE, 4)
    steps = steps_of(views, recipe, 0, recipe.resolution, Sharding(devices_for(4, jax.devices()[:1])))
    assert next(steps).photo.shape[0] == 4
    steps.close()


def test_steps_that_follow_do_not_depend_on_threads_or_on_where_a_run_starts(monkeypatch):
    views, recipe = capture(views=8).train, with_views(RECIPE, 3)

    def photos(threads, start):
        monkeypatch.setattr("splatax.training.groups.cores", lambda: threads)
        sharding = Sharding(devices_for(3, jax.devices()[:1]))
        steps = steps_of(views, recipe, start, recipe.resolution, sharding)
        found = [np.asarray(seen.photo) for seen in islice(steps, 6 - start)]
        steps.close()
        return found

    one = photos(1, 0)
    assert len({photo.tobytes() for photo in one}) == 6
    for ours, theirs in zip(one, photos(7, 0), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for ours, theirs in zip(one[2:], photos(7, 2), strict=True):
        np.testing.assert_array_equal(ours, theirs)
