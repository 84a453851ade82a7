"""Recipes: values in proportion to their steps, training, and the better one is better."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_training import capture, run

import splatax as sx
from scenes import camera_at
from splatax.demo.capture import write_capture
from splatax.training.density import Classic, NoDensityControl
from splatax.training.drawing import Drawing
from splatax.training.optimizer import LearningRates, rates_for
from splatax.training.recipes import PRESETS, ShSchedule, room_for, steps_for


@pytest.mark.parametrize("name", PRESETS)
def test_a_recipe_is_a_value(name):
    assert PRESETS[name].build(steps=700) == PRESETS[name].build(steps=700)
    assert hash(PRESETS[name].build()) == hash(PRESETS[name].build())
    assert PRESETS[name].build(steps=700, max_gaussians=900).density.max_gaussians == 900
    assert PRESETS[name].build(steps=700).steps == 700


def test_a_trained_scene_knows_its_filter_and_its_order():
    recipe = sx.Recipe(steps=1, drawing=Drawing(low_pass=sx.Antialiasing(), order="distance"))
    scene = sx.fit(capture(), recipe)
    assert scene.low_pass == sx.Antialiasing()
    assert scene.order == "distance"


@pytest.mark.parametrize("views", [1, 2])
def test_steps_that_draw_by_depth_follow_the_scene_by_depth(views):
    """With probability 1 a scene by distance is trained as one by depth; with 0 it is not."""
    usual = sx.Recipe(steps=3, views=views, density=NoDensityControl())
    drawings = (Drawing(), Drawing(order="distance", by_depth=1.0), Drawing(order="distance"))
    depth, always, never = (sx.fit(capture(), replace(usual, drawing=drawing)) for drawing in drawings)
    assert_array_equal(depth.means, always.means)
    assert np.abs(depth.means - never.means).max() > 1e-5


def test_half_of_the_steps_of_default_draw_by_depth():
    drawing = PRESETS["default"].build(steps=100).drawing
    keys = jax.random.split(jax.random.key(1), 400)
    _, by_depth = jax.vmap(drawing.sample)(keys)
    assert abs(float(by_depth.mean()) - drawing.by_depth) < 0.08
    assert drawing.in_order("depth").sample(keys[0])[1] is None


@pytest.mark.parametrize("name", PRESETS)
def test_photos_are_weighed_by_default_only_where_opacities_are_never_reset(name):
    resets = isinstance(PRESETS[name].build().density, Classic)
    assert not (resets and PRESETS[name].weighs_photos)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("steps", [600, 2000, 30_000])
def test_density_control_ends_before_training_does(name, steps):
    density = PRESETS[name].build(steps=steps).density
    due = [step for step in range(1, steps + 1) if density.due(step)]
    assert not due or due[-1] <= 0.85 * steps


@pytest.mark.parametrize("steps", [600, 2000, 30_000])
def test_default_grows_to_its_most_in_the_first_half(steps):
    density, count = PRESETS["default"].build(steps=steps, max_gaussians=50_000).density, 3000
    for step in range(1, steps // 2):
        if density.due(step):
            count = density.growth.after(count, step, density.every, density.max_gaussians)
    assert count == 50_000


@pytest.mark.parametrize("name", ["mcmc", "default"])
def test_training_grows_to_the_most_learns_and_repeats_bit_for_bit(name):
    recipe = PRESETS[name].build(steps=240, max_gaussians=200)
    density, sh = replace(recipe.density, every=20, start=20), replace(recipe.sh, degree=1)
    recipe = replace(recipe, density=density, sh=sh)
    first, second = (run(capture(), recipe) for _ in range(2))
    gaussians = first[-1][3].gaussians
    assert len(gaussians) == 200 if name == "default" else 80 < len(gaussians) < 200
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians))
    losses = [loss for _, loss, _, _ in first]
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:20])
    for a, b in zip(jax.tree.leaves(gaussians), jax.tree.leaves(second[-1][3].gaussians), strict=True):
        assert_array_equal(a, b)


def test_absgrad_is_classic_with_another_signal():
    absgrad, classic = (PRESETS[name].build(steps=2000).density for name in ("absgrad", "classic"))
    assert replace(classic, absolute=True, pull_threshold=8e-4) == absgrad


def test_absgrad_sees_pulls_that_cancel_out_for_classic():
    states = []
    for name in ("classic", "absgrad"):
        recipe = replace(PRESETS[name].build(steps=20), sh=ShSchedule(1))
        *_, (_, _, _, progress) = run(capture(), recipe)
        states.append(progress.state.train.density_state)
    classic, absgrad = states
    assert_array_equal(absgrad.views, classic.views)  # the same scene, seen alike
    assert_allclose(absgrad.screen, classic.screen)
    seen = np.asarray(classic.views) > 0
    assert np.all(np.asarray(absgrad.pull)[seen] >= 0.999 * np.asarray(classic.pull)[seen])
    assert np.sum(absgrad.pull) > 1.5 * np.sum(classic.pull)


def test_rates_are_raised_for_short_runs_and_never_fall_below_the_authors():
    authors = LearningRates()
    assert_allclose(rates_for(2000).means, 12 * authors.means)
    assert_allclose(rates_for(8000).log_scales, 2.25 * authors.log_scales)
    assert rates_for(10**7) == authors
    assert rates_for(1) == rates_for(500)


def test_long_runs_penalize_opacity_more_by_the_photos_that_they_look_at():
    def weight(*arguments, **options):
        return sx.recipes.default(*arguments, **options).objective.prior.opacity

    assert weight(7_999) == weight(999, views=8) == 0.003
    assert weight(8_000) == weight(1_000, views=8) == weight() == 0.01


def test_room_grows_with_pixels_and_with_the_root_of_the_number_of_photos():
    def photos(count, size):
        camera = camera_at(size=size)
        views = tuple(sx.View(str(number), camera, lambda: None) for number in range(count))
        return sx.Dataset(views, (), sx.PointCloud(*[np.zeros((0, 3), np.float32)] * 2))

    assert room_for(photos(1, (400, 200))) == 10_000
    assert_allclose(room_for(photos(9, (400, 200))), 30_000, atol=1)
    assert room_for(photos(100, (4000, 3000))) == 1_000_000
    assert room_for(photos(5000, (4000, 3000))) == 5_000_000
    assert steps_for(photos(1000, (400, 200))) == 30_000
    assert steps_for(photos(5000, (400, 200))) == 150_000


@pytest.mark.slow
def test_default_beats_classic_at_equal_steps(tmp_path):
    write_capture(tmp_path)
    dataset = sx.load_dataset(tmp_path)
    classic = sx.fit(dataset, PRESETS["classic"].build(steps=1000))
    default = sx.fit(dataset, PRESETS["default"].build(steps=1000, max_gaussians=len(classic)))
    assert len(default) <= len(classic)
    scores = [sx.evaluate(gaussians, dataset.test).psnr for gaussians in (default, classic)]
    assert scores[0] > scores[1] + 0.5
