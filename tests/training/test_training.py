"""Training on a tiny synthetic capture: it learns, repeats, and reports errors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.errors import DatasetError
from splatax.evaluation import photo_of, picture
from splatax.training.backgrounds import BACKGROUNDS, Solid
from splatax.training.density import Classic, NoDensityControl
from splatax.training.drawing import Drawing
from splatax.training.feed import Batch
from splatax.training.initialize import FromPoints, InFrusta, focus_distance
from splatax.training.loop import first_state
from splatax.training.optimizer import LearningRates, without_locked_bands
from splatax.training.priors import NoPrior
from splatax.training.recipes import PRESETS, ShSchedule, default
from splatax.training.step import _train_step, compare, photo_over, train_step

SIZE = (40, 32)


def capture(views=6, alpha=False):
    """Views from an arc around a cloud, and points near its Gaussians."""
    truth = random_gaussians(n=80, degree=0, spread=0.8, scale=(0.05, 0.25))
    cameras = [
        camera_at((4 * np.sin(a), 0.4, -4 * np.cos(a)), size=SIZE, focal=45.0)
        for a in np.linspace(-0.6, 0.6, views)
    ]
    photos = [np.asarray(picture(truth, camera)) for camera in cameras]
    if alpha:
        photos = [np.dstack([photo, np.full(photo.shape[:2], 255, np.uint8)]) for photo in photos]
    all_views = tuple(
        sx.View(f"{i}.png", camera, lambda photo=photo: photo)
        for i, (camera, photo) in enumerate(zip(cameras, photos, strict=True))
    )
    rng = np.random.default_rng(0)
    points = sx.PointCloud(
        np.asarray(truth.means) + rng.normal(size=(80, 3)).astype(np.float32) * 0.02,
        rng.uniform(size=(80, 3)).astype(np.float32),
    )
    return sx.Dataset(all_views[1:], all_views[:1], points)


RECIPE = sx.Recipe(
    steps=60, density=Classic(every=20, start=10, until=50, pull_threshold=1e-5), sh=ShSchedule(1, 20)
)


def run(dataset, recipe):
    return [
        (progress.step, float(progress.loss), progress.count, progress)
        for progress in sx.optimize(dataset, recipe)
    ]


def test_runs_that_differ_in_length_seed_or_size_share_one_program():
    dataset = capture(views=3)
    first = default(steps=3, max_gaussians=90)
    bands = replace(first, sh=ShSchedule(every=2))
    others = default(steps=5, max_gaussians=95), replace(first, seed=7), bands
    sx.fit(dataset, first)
    traced = _train_step._cache_size()
    for recipe in others:
        sx.fit(dataset, recipe)
    assert _train_step._cache_size() == traced
    sx.fit(dataset, replace(first, objective=replace(first.objective, prior=NoPrior())))
    assert _train_step._cache_size() == traced + 1


@pytest.fixture(scope="module")
def history():
    return run(capture(), RECIPE)


def test_loss_falls_and_the_scene_grows(history):
    losses = [loss for _, loss, _, _ in history]
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])
    assert [count for _, _, count, _ in history][-1] > 80


def test_training_predicts_a_photo_it_has_not_seen(history):
    dataset = capture()
    before = RECIPE.initialization(dataset, 1, 0)
    after = history[-1][3].gaussians
    assert sx.evaluate(after, dataset.test).psnr > sx.evaluate(before, dataset.test).psnr + 3


def test_quaternions_stay_unit_and_bands_open_one_after_the_other(history):
    final = history[-1][3].gaussians
    assert_allclose(np.linalg.norm(final.quats, axis=1), 1, rtol=1e-5)
    assert np.any(final.sh[:, 1:] != 0)
    gradients = jax.tree.map(jnp.ones_like, random_gaussians(n=2, degree=3))
    openings = jnp.asarray(ShSchedule(every=1000).openings(30_000))
    for step, free in ((0, 1), (999, 1), (1000, 4), (2000, 9), (3000, 16), (99_999, 16)):
        masked = without_locked_bands(gradients, jnp.float32(step / 30_000), openings).sh[0, :, 0]
        assert_array_equal(masked, np.arange(16) < free)


def test_the_same_seed_gives_the_same_scene_bit_for_bit(history):
    again = run(capture(), RECIPE)
    for a, b in zip(
        jax.tree.leaves(again[-1][3].gaussians), jax.tree.leaves(history[-1][3].gaussians), strict=True
    ):
        assert_array_equal(a, b)


def test_another_seed_gives_another_scene(history):
    other = run(capture(), replace(RECIPE, seed=1))
    assert np.any(
        np.asarray(other[-1][3].gaussians.means)[:5] != np.asarray(history[-1][3].gaussians.means)[:5]
    )


def test_fit_drains_optimize(history):
    fitted = sx.fit(capture(), RECIPE)
    assert_array_equal(fitted.means, history[-1][3].gaussians.means)


def test_a_scene_without_density_control_keeps_its_number():
    assert run(capture(), replace(RECIPE, steps=25, density=NoDensityControl()))[-1][2] == 80


@pytest.mark.parametrize("name", BACKGROUNDS)
def test_photos_with_alpha_are_composited_over_each_background(name):
    photo = jnp.array([[[255, 0, 0, 255], [255, 0, 0, 0], [255, 255, 255, 51]]], jnp.uint8)
    background = BACKGROUNDS[name].sample(jax.random.key(3))
    expected = [[1, 0, 0], background, 0.2 + 0.8 * background]
    assert_allclose(photo_over(photo, background)[0], expected, atol=1e-6)


def test_random_background_changes_with_the_step_and_white_does_not():
    random, white = BACKGROUNDS["random"], BACKGROUNDS["white"]
    assert np.any(random.sample(jax.random.key(0)) != random.sample(jax.random.key(1)))
    assert_array_equal(white.sample(jax.random.key(0)), 1)


def test_evaluation_composites_photos_with_alpha():
    pixels = np.array([[[255, 0, 0, 255], [255, 0, 0, 0]]], np.uint8)
    view = sx.View("a", camera_at(size=(2, 1)), lambda: pixels)
    assert photo_of(view, (1.0, 1.0, 1.0)).tolist() == [[[255, 0, 0], [255, 255, 255]]]


def test_training_on_photos_with_alpha_runs():
    assert np.isfinite(
        run(capture(alpha=True), replace(RECIPE, steps=3, drawing=Drawing(Solid((1.0, 1.0, 1.0)))))[-1][1]
    )


# --- the start ---


def test_gaussians_on_points_are_as_large_as_their_neighbours_are_far():
    dataset = capture()
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3).astype(np.float32)
    gaussians = FromPoints()(replace(dataset, points=sx.PointCloud(grid, np.full_like(grid, 0.25))), 2, 0)
    assert_allclose(gaussians.scales, 1, rtol=1e-5)
    assert_allclose(gaussians.opacities, 0.1, rtol=1e-5)
    assert gaussians.sh.shape == (64, 9, 3)
    assert_allclose(gaussians.sh[:, 0] * 0.28209479177387814 + 0.5, 0.25, rtol=1e-5)


def test_points_that_coincide_get_a_small_but_positive_size():
    dataset = capture()
    points = np.concatenate([np.zeros((5, 3)), np.eye(3)]).astype(np.float32)
    gaussians = FromPoints()(replace(dataset, points=sx.PointCloud(points, np.zeros_like(points))), 0, 0)
    assert np.all(np.isfinite(gaussians.log_scales))
    assert 0 < gaussians.scales[0, 0] < 0.1
    same = sx.PointCloud(np.zeros((5, 3), np.float32), np.zeros((5, 3), np.float32))
    assert np.all(np.isfinite(FromPoints()(replace(dataset, points=same), 0, 0).log_scales))


def test_points_that_stand_alone_are_left_out_and_no_others():
    rng = np.random.default_rng(0)
    near, far = rng.normal(size=(500, 3)), 1e3 + 400 * np.arange(6).reshape(2, 3)
    same = np.zeros((300, 3))  # as if half of all were found twice
    points = np.concatenate([near, far, same]).astype(np.float32)
    dataset = replace(capture(), points=sx.PointCloud(points, np.zeros_like(points)))
    means = np.asarray(FromPoints()(dataset, 0, 0).means)
    np.testing.assert_array_equal(means, np.concatenate([near, same]).astype(np.float32))
    assert len(FromPoints(isolation=np.inf)(dataset, 0, 0)) == len(points)


def test_random_start_fills_what_the_cameras_see():
    dataset = capture()
    gaussians = InFrusta(count=3000)(dataset, 0, seed=1)
    assert_allclose(focus_distance([view.camera for view in dataset.train], dataset.extent), 4, rtol=0.02)
    seen = [
        np.mean(np.asarray(sx.project(gaussians, view.camera).extents).all(axis=1)) for view in dataset.train
    ]
    assert min(seen) > 0.5
    depths = np.asarray(sx.project(gaussians, dataset.train[0].camera).depths)
    assert 0.2 * 4 < np.quantile(depths, 0.05) < 4 < np.quantile(depths, 0.95)


def test_random_start_trains_without_points():
    dataset = replace(
        capture(), points=sx.PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    )
    history = run(dataset, replace(RECIPE, initialization=InFrusta(count=500)))
    assert history[-1][1] < history[0][1]


# --- learning rates ---


def test_rate_of_means_falls_log_linearly_with_the_extent_in_it():
    rates = LearningRates()
    at = [float(rates.at(jnp.float32(p), jnp.float32([5.0]), 4).means[0, 0]) for p in (0, 0.5, 1)]
    assert_allclose(at, [5 * 1.6e-4, 5 * 1.6e-5, 5 * 1.6e-6], rtol=1e-5)


def test_higher_bands_learn_twenty_times_slower():
    sh = LearningRates().at(jnp.float32(0), jnp.float32([1]), 4).sh[0, :, 0]
    assert_allclose(sh, [2.5e-3] + [1.25e-4] * 3, rtol=1e-6)


def test_what_settles_keeps_its_rate_until_then_and_ends_at_a_fraction_of_it():
    rates = LearningRates(settled=0.01, settling_from=0.8)
    at = [rates.at(jnp.float32(p), jnp.float32([1.0]), 4) for p in (0, 0.8, 0.9, 1)]
    assert_allclose([float(r.opacity_logits[0]) for r in at], [0.05, 0.05, 0.005, 0.0005], rtol=1e-4)
    for field in ("quats", "log_scales", "sh"):
        assert_allclose(getattr(at[3], field), 0.01 * getattr(at[0], field), rtol=1e-4)
    usual = LearningRates().at(jnp.float32(1), jnp.float32([1.0]), 4)
    assert_allclose(at[3].means, usual.means)
    assert_array_equal(usual.quats, at[0].quats)  # the authors' do not settle


# --- bad input ---


def test_no_photos_and_no_steps_are_refused():
    dataset = capture()
    with pytest.raises(DatasetError, match="no photos to train on"):
        next(sx.optimize(replace(dataset, train=()), RECIPE))
    with pytest.raises(ValueError, match="steps of a recipe must be"):
        next(sx.optimize(dataset, replace(RECIPE, steps=0)))


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("most", [0, -1])
def test_a_recipe_for_less_than_a_gaussian_is_refused(name, most):
    with pytest.raises(ValueError, match=f"max_gaussians must be a whole number of at least 1, not {most}"):
        PRESETS[name].build(steps=10, max_gaussians=most)


def test_a_step_refuses_a_recipe_that_names_its_backend():
    dataset, named = capture(), RECIPE.on("xla")
    batch = Batch(dataset.train[0].camera, jnp.asarray(dataset.train[0].pixels()))
    state = first_state(named.initialization(dataset, 1, 0), named, 1.0, 5)
    told = r"names the backend 'xla'.*: look them up once, recipe\.on\(splatax\.backends\.resolve\('xla'\)\)"
    with pytest.raises(ValueError, match=told):
        train_step(state, batch, named)
    assert np.isfinite(state.gaussians.means).all(), "the state was not donated"
    with pytest.raises(ValueError, match=told):  # nor does traced code look the name up
        jax.eval_shape(lambda state: compare(state, batch, named, jax.random.key(0)).loss, state)


def test_a_photo_that_is_not_of_its_cameras_size_is_refused():
    dataset = capture()
    view = replace(dataset.train[0], pixels=lambda: np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"1.png: the photo has 6 x 5 pixels, its camera 40 x 32"):
        list(sx.optimize(replace(dataset, train=(view,)), RECIPE))


def test_extent_is_that_of_the_cameras_and_never_zero():
    dataset = capture()
    positions = np.stack([view.camera.position for view in dataset.train])
    radius = np.linalg.norm(positions - positions.mean(0), axis=1).max()
    assert_allclose(dataset.extent, 1.1 * radius, rtol=1e-5)
    lone = replace(dataset, train=dataset.train[:1])
    assert 3 < lone.extent < 5  # the distance of the points
    assert replace(lone, points=sx.PointCloud(*[np.zeros((0, 3), np.float32)] * 2)).extent == 1


def test_a_change_of_the_number_of_steps_survives_a_stop_at_its_very_step():
    dataset, recipe = capture(), sx.recipes.classic(steps=8)
    pace = {4: 6}.get
    *_, whole = sx.optimize(dataset, recipe, pace=pace)
    stopped = next(p for p in sx.optimize(dataset, recipe, pace=pace) if p.step == 4)
    *_, resumed = sx.optimize(dataset, recipe, stopped.state, pace)
    assert whole.step == resumed.step == 6
    for a, b in zip(jax.tree.leaves(whole.gaussians), jax.tree.leaves(resumed.gaussians), strict=True):
        assert_array_equal(a, b)
