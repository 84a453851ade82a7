"""Inaccurate cameras are corrected, and all cameras together do not drift."""

import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import random_gaussians
from splatax.cameras import RollingShutter
from splatax.cameras.lenses import Pinhole, opencv
from splatax.math import rigid
from splatax.training.camera_refinement import (
    CAMERA_REFINEMENTS,
    MANY,
    Distortion,
    Focal,
    Placed,
    Poses,
    Shutter,
    Together,
    rate_for,
    refined,
    unshared,
)
from splatax.training.density import NoDensityControl
from splatax.training.feed import batches, sources
from splatax.training.loop import first_state, optimize
from splatax.training.optimizer import LearningRates, Optimizer
from splatax.training.recipes import ShSchedule, default
from splatax.training.step import train_step
from training.test_training import RECIPE, capture

STILL = LearningRates(1e-12, 1e-12, 0.0, 0.0, 0.0, 0.0, 0.0)  # the scene is known


def turned(camera, twist):
    """A camera turned about its own centre, by world axes."""
    delta = rigid.exponential(jnp.concatenate([camera.rotation @ twist, jnp.zeros(3)]))
    return replace(camera, cam_from_world=delta @ camera.cam_from_world)


def perturbed(views, angle, seed=0):
    """All cameras turned by about an angle, radians, but not on average."""
    twists = np.random.default_rng(seed).normal(size=(len(views), 3))
    twists -= twists.mean(axis=0)
    twists *= angle / np.linalg.norm(twists, axis=1).mean()
    return tuple(
        replace(view, camera=turned(view.camera, jnp.asarray(twist, jnp.float32)))
        for view, twist in zip(views, twists, strict=True)
    )


def angles(views, truth):
    """Between cameras, radians."""
    ours, theirs = (np.stack([np.asarray(view.camera.rotation) for view in vs]) for vs in (views, truth))
    return np.linalg.norm(ours - theirs, axis=(1, 2)) / np.sqrt(2)


def learn(views, recipe, truth):
    """The cameras after a run on a scene that is known."""
    copy = jax.tree.map(jnp.array, truth)  # steps use up what they are given
    state = first_state(copy, recipe, 1.0, len(views))
    for _, batch in zip(range(recipe.steps), batches(views, 0), strict=False):
        state, _ = train_step(state, batch, recipe)
    return state, refined(recipe.camera_refinement, state.cameras, views, state.extent)


TRUTH = random_gaussians(n=80, degree=0, spread=0.8, scale=(0.05, 0.25))  # of `capture`
KNOWN = replace(
    RECIPE.on(sx.backends.resolve("auto")),
    steps=200,
    density=NoDensityControl(),
    optimizer=Optimizer(rates=STILL),
    sh=ShSchedule(0),
)


@pytest.mark.slow
def test_turned_cameras_come_back():
    views = capture().train
    wrong = perturbed(views, 1 / 45)  # a pixel
    state, found = learn(wrong, replace(KNOWN, camera_refinement=Poses(reach=0.1, longest=1.0)), TRUTH)
    assert angles(wrong, views).mean() > 0.02
    assert angles(found, views).mean() < 0.2 * angles(wrong, views).mean()
    assert_allclose(jnp.mean(state.cameras.values, axis=0), 0, atol=1e-6)


def test_a_wrong_focal_length_comes_back():
    views = capture().train
    wrong = tuple(
        replace(v, camera=replace(v.camera, fx=v.camera.fx * 1.03, fy=v.camera.fy * 1.03)) for v in views
    )
    recipe = replace(KNOWN, camera_refinement=Together((Focal(reach=0.1), Poses(reach=1e-6))))
    _, found = learn(wrong, recipe, TRUTH)
    ratios = [float(a.camera.fx / b.camera.fx) for a, b in zip(found, views, strict=True)]
    assert_allclose(ratios, ratios[0], rtol=1e-6)  # one lens
    assert abs(ratios[0] - 1) < 0.006


def test_cameras_with_the_same_numbers_share_a_lens():
    views = capture().train
    other = replace(views[2], camera=replace(views[2].camera, fx=views[2].camera.fx + 1))
    found = sources((*views[:2], other, *views[3:]))
    assert [int(source.lens) for source in found] == [0, 0, 1, 0, 0]
    assert [int(source.view) for source in found] == [0, 1, 2, 3, 4]


def test_the_steps_of_a_run_are_as_long_as_the_reach():
    visits = 500.0
    rates = [rate_for(0.02, visits, jnp.float32(i / visits)) for i in range(500)]
    assert_allclose(sum(rates), 0.02, rtol=0.01)


def test_a_photo_that_is_seen_few_times_moves_by_a_fraction_of_a_pixel_a_step():
    """In a short run, steps that add up to the whole reach would throw right poses off by pixels."""
    views, poses = capture().train, Poses()
    source, state = sources(views)[0], poses.init(len(views))
    state = poses.update(state, source, jnp.full(6, 1e-9), jnp.float32(0), jnp.float32(10 * len(views)))
    pixels = state.values[0] * views[0].camera.focal[0]
    assert jnp.max(jnp.abs(pixels)) <= 0.15


@pytest.mark.parametrize(("photos", "left"), [(MANY, 0.0), (MANY - 1, 0.5)])
def test_many_cameras_together_do_not_turn_move_grow_or_bend(photos, left):
    """What the scene can follow is no correction of a single camera. Few cameras keep all but their mean."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(photos, 3)) * [3, 1, 2] + 5
    common = rng.normal(size=6) + places @ rng.normal(size=(3, 6))
    table = Poses().init(photos)
    visited = table.opt_state._replace(count=jnp.ones(photos, jnp.int32))
    table = Placed(jnp.asarray(common, jnp.float32), visited, jnp.asarray(places, jnp.float32))
    spread = table.values - table.values.mean(0, keepdims=True)
    remaining = jnp.linalg.norm(unshared(table)) / jnp.linalg.norm(spread)
    assert remaining <= 0.02 if left == 0 else remaining > left
    one = jnp.zeros((photos, 6)).at[0, 1].set(1.0)  # the error of one camera stays
    assert unshared(replace(table, values=one))[0, 1] > 0.5


def test_the_reach_limits_the_steps_of_long_runs():
    views, poses = capture().train, Poses()
    source, visits = sources(views)[0], 5000.0
    rate = rate_for(poses.reach, visits, jnp.float32(0))
    assert rate < poses.longest * source.pixel
    gradient, steps = jnp.full(6, 1e-9), jnp.float32(visits * len(views))
    state = poses.update(poses.init(len(views)), source, gradient, jnp.float32(0), steps)
    assert_allclose(state.values[0] - state.values[1], -rate, rtol=1e-3)


def test_given_cameras_stay():
    dataset = capture()
    for progress in optimize(dataset, replace(RECIPE, steps=2)):
        pass
    state = progress.state.train
    assert jax.tree.leaves((state.cameras, state.appearance)) == []
    found = refined(RECIPE.camera_refinement, state.cameras, dataset.train, state.extent)
    assert [view.camera for view in found] == [view.camera for view in dataset.train]


@pytest.mark.slow
def test_refinement_recovers_what_cameras_wrong_by_a_pixel_cost(data):
    """fern at a third of its size. Test cameras are right, so their PSNR tells how good the scene is."""
    dataset = sx.load_dataset(data / "fern", downscale=3)
    steps = int(os.environ.get("SPLATAX_REFINEMENT_STEPS", "600"))
    recipe = default(steps, 15_000)
    focal = float(dataset.train[0].camera.fx)
    wrong = replace(dataset, train=perturbed(dataset.train, 1 / focal))

    def run(dataset, recipe):
        for progress in optimize(dataset, recipe):
            pass
        state = progress.state.train
        psnr = sx.evaluate(progress.gaussians, dataset.test).psnr
        return psnr, refined(recipe.camera_refinement, state.cameras, dataset.train, state.extent)

    right, _ = run(dataset, recipe)
    lost, _ = run(wrong, recipe)
    regained, found = run(wrong, replace(recipe, camera_refinement=Poses()))
    before, after = (1e3 * angles(views, dataset.train).mean() for views in (wrong.train, found))
    print(f"PSNR {right:.2f}, {lost:.2f}, {regained:.2f} dB; angles {before:.2f}, {after:.2f} mrad")
    assert right - lost > 1
    assert regained - lost > 0.15 * (right - lost)  # the part linear in the places stays


@pytest.mark.slow
def test_refinement_does_not_make_accurate_poses_worse(data):
    """fox at half size. Runs of two seeds differ by 0.1 dB."""
    dataset = sx.load_dataset(data / "fox", downscale=2)
    given = default(1_500, 15_000)
    kept, moved = (
        sx.evaluate(sx.fit(dataset, recipe), dataset.test).psnr
        for recipe in (given, replace(given, camera_refinement=Poses()))
    )
    print(f"PSNR {kept:.2f}, refined {moved:.2f} dB")
    assert moved > kept - 0.5


@pytest.mark.slow
def test_distortion_that_a_capture_lacks_is_found():
    """Photos of a lens with k1 and k2, given as those of a pinhole."""
    lens = opencv(-0.12, 0.04)
    views = []
    for view in capture().train:
        camera = replace(view.camera, lens=lens)
        photo = np.asarray(jnp.round(255 * jnp.clip(sx.render(TRUTH, camera, backend="xla").rgb, 0, 1)))
        views.append(replace(view, camera=camera, pixels=lambda photo=photo: photo.astype(np.uint8)))
    wrong = tuple(replace(view, camera=replace(view.camera, lens=Pinhole())) for view in views)
    recipe = replace(KNOWN, steps=300, camera_refinement=Distortion(reach=2.0))
    _, found = learn(wrong, recipe, TRUTH)
    corner = jnp.array([1.0, -1.0]) * view_corner(views[0].camera)
    for fraction in (0.25, 0.5, 0.75, 1.0):  # k1 and k2 trade against each other; places of pixels tell
        place = jnp.append(fraction * corner, 1.0)
        expected = views[0].camera.to_pixel(place)
        assert np.linalg.norm(wrong[0].camera.to_pixel(place) - expected) > 0.3 or fraction < 1
        for view in found:
            assert_allclose(view.camera.to_pixel(place), expected, atol=0.1)


def photographed(view, camera):
    """The view of another camera of the known scene, with its photo."""
    photo = np.asarray(jnp.round(255 * jnp.clip(sx.render(TRUTH, camera, backend="xla").rgb, 0, 1)))
    return replace(view, camera=camera, pixels=lambda: photo.astype(np.uint8))


def places_during(view):
    """Pixels of the Gaussians for the first and the last row of the exposure."""
    ends = [view.camera.at(jnp.float32(time)) for time in (-0.5, 0.5)]
    return np.stack([[end.to_pixel(end.to_camera(mean)) for mean in TRUTH.means[:20]] for end in ends])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "refinement"),
    [
        ("shutter", Shutter(reach=0.3)),
        ("poses+shutter", Together((Shutter(reach=0.3), Poses(reach=0.01)))),
    ],
)
def test_a_motion_during_the_exposure_that_a_capture_lacks_is_found(name, refinement):
    """Photos of cameras that move while their rows are exposed, given as if the cameras stood still."""
    assert jax.tree.structure(refinement.init(5)) == jax.tree.structure(CAMERA_REFINEMENTS[name].init(5))
    rng, views = np.random.default_rng(0), []
    for view in capture().train:
        twist = jnp.asarray(rng.normal(size=6) * np.repeat([0.04, 0.1], 3), jnp.float32)
        views.append(photographed(view, replace(view.camera, motion=RollingShutter(twist))))
    still = tuple(replace(view, camera=replace(view.camera, motion=None)) for view in views)
    _, found = learn(still, replace(KNOWN, steps=400, camera_refinement=refinement), TRUTH)
    off = []
    for ours, given, truth in zip(found, still, views, strict=True):
        assert isinstance(ours.camera.motion, RollingShutter)
        expected = places_during(truth)
        before, after = (np.linalg.norm(places_during(v) - expected, axis=2).max() for v in (given, ours))
        assert before > 0.5  # pixels
        assert after < 0.2 * before
        # A turn and a move look alike to a camera that is four units away: what they have in common is exact
        # above, and their difference is learned slowly. A motion that is ignored is off by 1.
        twist, expected = (
            np.repeat([1.0, 1 / 4], 3) * np.asarray(v.camera.motion.twist) for v in (ours, truth)
        )
        off.append(np.linalg.norm(twist - expected) / np.linalg.norm(expected))
    assert max(off) < 0.65


def test_a_motion_is_learned_on_top_of_the_given_one():
    """The translation is in extents of the scene; the exposure keeps its direction."""
    given = RollingShutter(jnp.array([0.01, 0, 0, 0, 0.2, 0]), "left")
    camera = replace(capture().train[0].camera, motion=given)
    moved = Shutter()(jnp.array([0, 0.02, 0, 0.1, 0, 0]), camera, jnp.float32(3.0)).motion
    assert_allclose(moved.twist, [0.01, 0.02, 0, 0.3, 0.2, 0], rtol=1e-6)
    assert moved.direction == "left"


def view_corner(camera):
    """Slopes of the corner of a camera's image."""
    return jnp.array([camera.width, camera.height]) / 2 / camera.focal
