"""Regularizers of geometry: values on analytic scenes, gradients, and training."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, plane_of_gaussians, random_gaussians, with_slots
from splatax import backends
from splatax.outputs import OUTPUTS, Output
from splatax.surfaces import positions_of
from splatax.training.feed import MOST_LANDMARKS, Batch, landmarks_of
from splatax.training.geometry import FACING, LAYERS, Layers, Surfaces, error_at, inconsistency, saturated
from splatax.training.loop import first_state
from splatax.training.objectives import TrainingView
from splatax.training.priors import Flatness, Priors, Sparsity
from splatax.training.recipes import Objective
from splatax.training.step import compare
from training.test_training import RECIPE, capture

CAMERA = camera_at((0.3, 0.2, -3.0), size=(32, 24))
FRONT = np.array([0.0, 0.0, -1.0])
SURFACES = Surfaces(spread=0.3, consistency=0.2, points=0.4, consistency_limit=0.5, after=0.0)


def test_the_spread_of_two_layers_is_their_standard_deviation():
    """The layers have the weights 0.6 and 0.4 * 0.5, and the inverse depths 1 / 2 and 1 / 4."""
    layers = [
        replace(
            plane_of_gaussians(FRONT, n=1, half=0.0, sigma=3.0, opacity=opacity),
            means=jnp.array([[0.0, 0.0, depth]]),
        )
        for depth, opacity in ((2.0, 0.6), (4.0, 0.5))
    ]
    both = jax.tree.map(lambda *rows: jnp.concatenate(rows), *layers)
    camera = replace(sx.Camera.simple_pinhole(30.0, jnp.eye(4), 1, 1), cx=jnp.float32(0.5))
    drawn = sx.render(both, camera, outputs={"layers": LAYERS, "alpha": OUTPUTS["alpha"]})
    weights, near = np.array([0.6, 0.2]), np.array([1 / 2, 1 / 4])
    mean = weights @ near / weights.sum()
    deviation = np.sqrt(weights @ (near - mean) ** 2 / weights.sum())
    assert_allclose(drawn.layers.spread[0, 0], drawn.alpha[0, 0] * deviation / mean, rtol=2e-3)


def test_one_layer_has_no_spread_and_is_consistent():
    outputs = {"layers": LAYERS, "facing": FACING, "surface_depth": OUTPUTS["surface_depth"]}
    camera = camera_at((1.0, 0.0, -3.0))  # the plane is seen at an angle
    drawn = sx.render(plane_of_gaussians(FRONT, n=2000, half=3.0, sigma=0.3), camera, outputs=outputs)
    assert float(drawn.layers.spread.max()) < 2e-3  # rounding of float32
    assert_allclose(drawn.layers.depth, drawn.surface_depth, rtol=1e-5)
    assert abs(inconsistency(drawn.facing, drawn.surface_depth, camera)) < 1e-5
    tilted = drawn.facing.at[..., :3].set(0.5 * drawn.facing[..., :3])  # a cosine of 1 / 2
    assert_allclose(inconsistency(tilted, drawn.surface_depth, camera), 0.5, atol=1e-3)
    assert_allclose(inconsistency(tilted, drawn.surface_depth, camera, limit=0.5), 0.25, atol=1e-3)


@pytest.mark.slow
def test_the_error_at_landmarks_counts_those_that_the_view_shows():
    depth = jnp.full((24, 32), 3.0)
    points = positions_of(CAMERA, 1.1 * depth).reshape(-1, 3)
    aside, behind = points[:5] + jnp.array([[90.0, 0, 0]]), 2 * CAMERA.position[None] - points[:5]
    known = jnp.concatenate([points, aside, behind, jnp.full((7, 3), jnp.nan)])
    assert_allclose(error_at(known, depth, CAMERA), 0.1, rtol=1e-4)
    assert error_at(known[-7:], depth, CAMERA) == 0
    assert error_at(known, 0 * depth, CAMERA) == 0
    gradient = jax.grad(lambda depth: error_at(known, depth, CAMERA))(depth)
    assert np.isfinite(gradient).all()
    assert (np.asarray(gradient) < 0).any()  # farther is better


def test_the_error_at_landmarks_between_pixels_is_zero_on_a_plane():
    plane = plane_of_gaussians(FRONT, n=2000, half=3.0, sigma=0.3)
    depth = sx.render(plane, CAMERA, outputs=("surface_depth",)).surface_depth
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.9, 0.9, (40, 3)) * [1, 0.6, 0], jnp.float32)
    assert error_at(points, depth, CAMERA) < 1e-5


def test_errors_pull_less_the_farther_they_are_beyond_their_limit():
    errors = jnp.array([0.0, 1e-4, 0.02, 0.18, 50.0])
    values, slopes = jax.vmap(jax.value_and_grad(lambda error: saturated(error, 0.02)))(errors)
    assert_allclose(values, [0, 1e-4 / 1.005, 0.01, 0.018, 0.02], rtol=1e-3)
    assert_allclose(slopes, [1, 1 / 1.005**2, 1 / 4, 1 / 100, 0], atol=1e-6)
    assert_array_equal(saturated(errors, np.inf), errors)


@pytest.mark.slow
def test_wrong_points_hardly_pull_the_depth_that_right_ones_agree_on():
    """A wall at 1.01 times the depth of some points; as many others are three times as far."""
    wall = jnp.full((24, 32), 3.0)
    near = positions_of(CAMERA, 3.0 / 1.01 * jnp.ones_like(wall)).reshape(-1, 3)
    known = jnp.concatenate([near[::2], positions_of(CAMERA, 3 * wall).reshape(-1, 3)[1::2]])

    def pull(limit):
        return jax.grad(lambda depth: error_at(known, depth * wall, CAMERA, limit=limit))(jnp.float32(1))

    assert pull(np.inf) < 0  # the far ones win: their relative error has the larger slope
    assert pull(Surfaces().points_limit) > 0


@pytest.mark.slow
def test_the_penalty_has_the_gradient_of_finite_differences(x64):
    gaussians = random_gaussians(n=12, degree=0, scale=(0.3, 0.6), dtype=np.float64)
    camera = camera_at((0.3, 0.2, -3.0), size=(8, 6), focal=8.0, dtype=np.float64)
    landmarks = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3)))

    @jax.jit
    def penalty(gaussians):
        drawn = sx.render(gaussians, camera, outputs=SURFACES.outputs, backend="xla")
        return SURFACES(drawn.images, TrainingView(camera, landmarks, jnp.zeros(())))

    gradient = jax.jit(jax.grad(penalty))(gaussians)
    rng = np.random.default_rng(1)
    for _ in range(3):
        direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), gaussians)
        sides = [
            penalty(jax.tree.map(lambda p, d, s=step: p + s * d, gaussians, direction))
            for step in (1e-7, -1e-7)
        ]
        along = sum(map(jnp.vdot, jax.tree.leaves(gradient), jax.tree.leaves(direction)))
        assert along != 0
        assert_allclose(along, (sides[0] - sides[1]) / 2e-7, rtol=2e-4, atol=1e-7)


def test_a_step_adds_the_penalty_and_its_gradient_to_those_of_the_photo():
    dataset, camera = capture(), capture().train[0].camera
    recipe = RECIPE.on(backends.resolve("auto"))
    scene = recipe.initialization(dataset, 1, 0)
    axes = jax.random.normal(jax.random.key(1), (len(scene), 3))  # round Gaussians hide how they are turned
    scene = replace(scene, log_scales=scene.log_scales + 0.5 * axes, quats=scene.quats + 0.3)
    state = first_state(scene, recipe, 1.0, 5)
    landmarks = jnp.asarray(dataset.points.positions)
    batch = Batch(camera, jnp.asarray(dataset.train[0].pixels()), landmarks=landmarks)

    def penalty(gaussians):
        drawn = sx.render(gaussians, camera, outputs=SURFACES.outputs, low_pass=recipe.drawing.low_pass)
        return SURFACES(drawn.images, TrainingView(camera, landmarks, jnp.zeros(())))

    def step(geometry):
        chosen = replace(recipe, objective=replace(recipe.objective, geometry=geometry))

        @jax.jit
        def compared(state):
            found = compare(state, batch, chosen, jax.random.key(0))
            return found.loss, found.pull_back(found.d_shown)[0]

        return compared(state)

    plain, without = step(recipe.objective.geometry)
    total, found = step(SURFACES)
    value, gradient = jax.jit(jax.value_and_grad(penalty))(state.gaussians)
    assert value > 0.01
    assert_allclose(total, plain + value, rtol=1e-5)
    for whole, photo, part in zip(*map(jax.tree.leaves, (found, without, gradient)), strict=True):
        assert_allclose(whole, photo + part, atol=1e-3 * max(float(jnp.abs(whole).max()), 1e-6))


@pytest.mark.slow
def test_without_regularizers_only_colours_are_drawn():
    widths = []
    portable = backends.resolve("xla")

    def composite(splats, channels):
        widths.append(channels.shape[1])
        return portable.composite(splats, channels)

    dataset = capture()
    batch = Batch(dataset.train[0].camera, jnp.asarray(dataset.train[0].pixels()))
    for geometry in (Objective().geometry, Surfaces(0.1, 0.0, 0.0), Surfaces(0.1, 0.1, 0.0)):
        kernels = replace(portable, name=f"counting {geometry}", composite=composite)
        recipe = replace(RECIPE.on(kernels), objective=Objective(geometry=geometry))
        state = first_state(recipe.initialization(dataset, 1, 0), recipe, 1.0, 5)
        jax.eval_shape(
            lambda state, recipe=recipe: compare(state, batch, recipe, jax.random.key(0))[0], state
        )
    assert sorted(set(widths)) == [3, 9, 12]


@pytest.mark.slow
def test_training_with_surfaces_moves_the_drawn_depth_to_the_landmarks():
    dataset = capture()
    points = dataset.points.positions
    views = tuple(replace(view, landmarks=lambda: points) for view in dataset.train)
    recipe = replace(RECIPE, steps=12)
    errors = []
    for weight in (0.0, 5.0):
        objective = Objective(geometry=Surfaces(0.0, 0.0, weight, points_limit=1.0, after=0.0))
        trained = sx.fit(replace(dataset, train=views), replace(recipe, objective=objective))
        depth = sx.render(trained, views[0].camera, outputs=("surface_depth",)).surface_depth
        errors.append(error_at(jnp.asarray(points), depth, views[0].camera))
    assert errors[1] < 0.9 * errors[0]


def test_penalties_that_begin_late_grow_to_their_weights_within_a_tenth_of_the_run():
    camera = camera_at((0.0, 0.0, -4.0), size=(8, 6))
    layers = Layers(jnp.full((6, 8), 4.0), jnp.full((6, 8), 0.02), jnp.zeros((6, 8)))
    facing = jnp.zeros((6, 8, 4)).at[..., 3].set(1.0)
    landmarks = jnp.array([[0.0, 0.0, 1.0]])

    def penalty(surfaces, progress):
        images = {"layers": layers, "facing": facing}
        return surfaces(images, TrainingView(camera, landmarks, jnp.float32(progress)))

    whole = penalty(Surfaces(after=0.0), 0.0)
    assert whole > Surfaces.spread * 0.02 / 1.4 * 0.99
    for progress, fraction in ((0.0, 0), (0.4, 0), (0.45, 0.5), (0.5, 1), (1.0, 1)):
        assert_allclose(penalty(Surfaces(after=0.4), progress), fraction * whole, rtol=1e-5)
    for progress, fraction in ((0.95, 0), (0.975, 0.5), (1.0, 1)):  # there is less than a tenth left
        assert_allclose(penalty(Surfaces(after=0.95), progress), fraction * whole, rtol=1e-5, atol=1e-9)
    for after in (-0.1, 1.0, float("nan")):
        with pytest.raises(ValueError, match="from 0 to below 1"):
            Surfaces(after=after)


def test_outputs_are_drawn_from_the_step_on_at_which_their_penalties_begin():
    drawn, portable = [], backends.resolve("xla")

    def composite(splats, channels):
        if channels.shape[1] > 3:
            jax.debug.callback(lambda: drawn.append(made))
        return portable.composite(splats, channels)

    kernels = replace(portable, name="telling", composite=composite)
    objective = Objective(geometry=Surfaces(0.1, 0.0, 0.0, after=0.5))
    made = 0
    for progress in sx.optimize(capture(), replace(RECIPE.on(kernels), objective=objective, steps=4)):
        jax.block_until_ready(progress.loss)
        jax.effects_barrier()
        made = progress.step
    assert drawn == [2, 3]


def test_landmarks_of_all_views_have_one_shape():
    dataset = capture()
    many = np.arange(3 * (MOST_LANDMARKS + 5), dtype=np.float32).reshape(-1, 3)
    views = [
        replace(dataset.train[0], landmarks=lambda: many),
        dataset.train[1],
        replace(dataset.train[2], landmarks=lambda: many[:2]),
    ]
    rows = landmarks_of(views)
    assert rows.shape == (3, (MOST_LANDMARKS + 6) // 2, 3)
    assert_array_equal(rows[0], many[::2])
    assert np.isnan(rows[1]).all()
    assert_array_equal(rows[2, :2], many[:2])
    assert np.isnan(rows[2, 2:]).all()
    assert landmarks_of(dataset.train) is None


LIVING = jnp.int32(3)


def test_flatness_is_the_mean_thickness_of_the_living():
    gaussians = with_slots([0.3, 0.7, 0.5])
    expected = 2 * np.mean(np.min(np.asarray(gaussians.scales[:3]), axis=1)) / 4
    assert_allclose(Flatness(2.0)(gaussians, jnp.float32(4.0), LIVING), expected, rtol=1e-6)
    gradient = jax.grad(Flatness())(gaussians, jnp.float32(4.0), LIVING).log_scales
    assert_array_equal(gradient[3:], 0)
    assert ((np.asarray(gradient[:3]) > 0).sum(axis=1) == 1).all()
    both = Priors((Sparsity(), Flatness(2.0)))
    assert_allclose(
        both(gaussians, jnp.float32(4), LIVING),
        Sparsity()(gaussians, jnp.float32(4), LIVING) + expected,
        rtol=1e-6,
    )


def test_an_output_of_ones_own_can_be_a_regularizer():
    """Settings that compare equal have outputs that do, so that steps share one compiled program."""
    assert Surfaces() == Surfaces()
    assert Surfaces().outputs == Surfaces().outputs
    assert all(isinstance(output, Output) for output in Surfaces().outputs.values())
