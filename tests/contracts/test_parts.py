"""Scenes of parts equal their flattened Gaussians on every backend, and their poses are traced."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from enrolled import NAMES, kernels
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.cameras.lenses import Equirectangular
from splatax.cameras.motion import RollingShutter
from splatax.scene import ColorMap
from splatax.transforms import Similarity

CAMERA = camera_at((0.4, -0.5, -4.0), size=(48, 40), focal=40.0)
BODY = random_gaussians(0, n=60, degree=2, scale=(0.05, 0.3))
WHEEL = random_gaussians(1, n=40, degree=1, scale=(0.05, 0.2))
AWAY = Similarity.of(degrees=(20.0, -50.0, 130.0), scale=0.6, move=(0.5, -0.3, 0.4))
MAP = ColorMap(
    np.array([[0.2, 0.7, 0.0], [0.1, 0.3, 0.4], [0.0, 0.0, 1.5]], np.float32),
    np.array([0.1, -0.05, 0.0], np.float32),
)


def scene(**wheel) -> sx.Scene:
    """Two parts that interpenetrate, of different harmonics."""
    return sx.Scene({"wheel": sx.Part(WHEEL, **({"pose": AWAY} | wheel)), "body": sx.Part(BODY)})


def test_a_scene_of_parts_is_the_picture_of_its_baked_gaussians(backend):
    parts = scene(color=MAP)
    outputs = ("rgb", "alpha", "depth", "distance")
    drawn = sx.render(parts, CAMERA, outputs=outputs, backend=backend)
    baked = sx.render(parts.flattened(), CAMERA, outputs=outputs, backend=backend)
    assert baked.rgb.std() > 0.1
    for name in outputs:  # float32 through other coordinates
        assert_allclose(getattr(drawn, name), getattr(baked, name), rtol=2e-3, atol=2e-3)


@pytest.mark.slow
def test_a_camera_that_moves_during_the_exposure_sees_a_part_as_its_baked_gaussians():
    twist = jnp.array([0.02, -0.05, 0.03, 0.1, -0.05, 0.08])
    camera = replace(CAMERA, motion=RollingShutter(twist))
    part = sx.Scene({"wheel": sx.Part(WHEEL, AWAY)})
    drawn, baked = (sx.render(seen, camera, outputs=("rgb",)).rgb for seen in (part, part.flattened()))
    assert baked.std() > 0.05
    assert_allclose(drawn, baked, atol=2e-3)


def test_outputs_of_surfaces_and_of_panoramas_know_where_the_parts_are():
    parts = scene()
    outputs = ("normals", "surface_depth", "alpha")
    drawn, baked = (sx.render(seen, CAMERA, outputs=outputs) for seen in (parts, parts.flattened()))
    assert (baked.alpha > 0.5).any()
    for name in outputs:  # planes that are seen edge-on feel the rounding
        assert np.quantile(np.abs(getattr(drawn, name) - getattr(baked, name)), 0.99) < 5e-3
    around = replace(CAMERA, lens=Equirectangular(), fx=jnp.float32(48 / (2 * np.pi)))
    whole = sx.render(parts, around, outputs=("parts", "alpha"))
    assert whole.alpha.max() > 0.5
    assert_allclose(whole.parts.sum(axis=2), whole.alpha, atol=1e-5)


def test_interleaved_parts_are_drawn_in_one_order_of_depths():
    """Two parts whose Gaussians alternate along the axis, opaque enough to hide each other."""
    n = 12
    row = random_gaussians(3, n=n, degree=0, spread=0.3, scale=(0.2, 0.3))
    z = np.linspace(-1, 1, n, dtype=np.float32)
    row = replace(row, means=row.means.at[:, 2].set(z), opacity_logits=jnp.full(n, 2.0))
    halves = {name: jax.tree.map(lambda leaf, i=i: leaf[i::2], row) for i, name in enumerate(("odd", "even"))}
    split = sx.Scene({name: sx.Part(half) for name, half in halves.items()})
    whole = sx.render(row, CAMERA)
    assert_allclose(sx.render(split, CAMERA).rgb, whole.rgb, atol=1e-6)
    one_after_another = sx.render(halves["odd"], CAMERA, background=sx.render(halves["even"], CAMERA).rgb)
    assert np.abs(one_after_another.rgb - whole.rgb).max() > 0.05  # the truth that the test can tell apart


@pytest.mark.slow
def test_a_small_part_is_culled_at_the_near_plane_of_the_world():
    """A part of scale 1/1000 at a depth of 1 is seen; one of scale 1000 is culled nearer than 0.01 only."""
    one = replace(jax.tree.map(lambda leaf: leaf[:1], BODY), means=jnp.zeros((1, 3)))
    one = replace(one, opacity_logits=jnp.full(1, 2.0), log_scales=jnp.full((1, 3), -3.0))
    for scale, size in ((1e-3, 1e3), (1e3, 1e-3)):
        sized = replace(one, log_scales=one.log_scales + np.float32(np.log(size)))
        for depth, drawn in ((0.5, True), (0.02, True), (0.005, False)):
            pose = Similarity.of(scale=scale, move=(0.0, 0.0, depth))
            camera = replace(CAMERA, cam_from_world=jnp.eye(4))
            alpha = sx.render(sx.Scene({"one": sx.Part(sized, pose)}), camera, outputs=("alpha",)).alpha
            assert (alpha.max() > 0.1) == drawn, (scale, depth)


@pytest.mark.slow
def test_poses_have_the_gradient_of_finite_differences():
    target = sx.render(scene(), CAMERA).rgb
    guess = Similarity.of(degrees=(25.0, -40.0, 125.0), scale=0.63, move=(0.45, -0.25, 0.5)).cast(jnp.float32)

    def loss(x):
        pose = Similarity.from_twist(x[:6]).after(guess)
        pose = replace(pose, scale=pose.scale * jnp.exp(x[6]))
        drawn = sx.render(scene(pose=pose), CAMERA, outputs=("rgb",))
        return 100 * jnp.mean(jnp.square(drawn.rgb - target))

    zero, step = jnp.zeros(7), 2e-3
    value = jax.jit(loss)
    moved = [[value(zero.at[i].set(sign * step)) for sign in (1, -1)] for i in range(7)]
    expected = np.array([(a - b) / (2 * step) for a, b in moved])
    gradient = jax.grad(loss)(zero)
    assert (np.abs(expected) > 0.02).sum() >= 6
    # Splats that appear and vanish at 1/255 make steps of a float32 image.
    assert_allclose(gradient, expected, rtol=0.1, atol=0.03 * np.abs(expected).max())


def test_posing_showing_and_colouring_compile_once():
    traces = []

    @jax.jit
    def draw(parts):
        traces.append(1)
        return sx.render(parts, CAMERA, outputs=("rgb",)).rgb

    before = sx.scene.seen.checked(scene(color=MAP))
    images = []
    for i in range(3):
        turned = Similarity.of(degrees=(0.0, 30.0 * i, 0.0)).cast(jnp.float32)
        parts = before.posed({"wheel": turned}).shown({"body": jnp.float32(i < 2)})
        images.append(draw(parts.colored({"wheel": jax.tree.map(lambda x: jnp.asarray(x) * 0.5, MAP)})))
    assert len(traces) == 1
    assert np.abs(images[0] - images[1]).max() > 0.05
    assert np.abs(images[1] - images[2]).max() > 0.05


def test_a_batch_of_poses_is_the_poses_one_by_one():
    rng = np.random.default_rng(0)
    quats = jnp.asarray(rng.normal(size=(3, 4)), jnp.float32)
    places = jnp.asarray(rng.uniform(-0.5, 0.5, (3, 3)), jnp.float32)
    poses = jax.vmap(Similarity.from_quat)(quats, places)

    def draw(pose):
        return sx.render(scene(pose=pose), CAMERA, outputs=("rgb",)).rgb

    together = jax.vmap(draw)(poses)
    for i in range(3):
        assert_allclose(together[i], draw(jax.tree.map(lambda leaf, i=i: leaf[i], poses)), atol=2e-5)


def test_a_hidden_part_is_not_drawn_and_has_no_gradient():
    hidden = sx.scene.seen.checked(scene(visible=False, color=MAP))
    body = sx.Scene({"body": sx.Part(BODY)})
    expected = sx.render(body, CAMERA)
    assert_array_equal(sx.render(hidden, CAMERA).rgb, expected.rgb)

    def loss(parts):
        return jnp.sum(sx.render(parts, CAMERA, outputs=("rgb",)).rgb)

    gradient = jax.grad(loss)(hidden)
    for leaf in jax.tree.leaves(gradient["wheel"]):
        assert_array_equal(leaf, 0)
    assert np.abs(gradient["body"].gaussians.means).max() > 0


def test_broken_rows_leave_the_gradients_of_pose_and_colour_finite():
    broken = replace(WHEEL, means=WHEEL.means.at[0, 0].set(jnp.nan), sh=WHEEL.sh.at[1, 0, 0].set(jnp.inf))

    def loss(part):
        return jnp.sum(sx.render(sx.Scene({"wheel": part}), CAMERA, outputs=("rgb",)).rgb)

    color = jax.tree.map(jnp.asarray, MAP)
    gradient = jax.grad(loss)(sx.Part(broken, AWAY.cast(jnp.float32), 1.0, color))
    for leaf in jax.tree.leaves((gradient.pose, gradient.color)):
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() > 0


def test_the_parts_of_a_pixel_add_up_to_its_alpha_and_contributors_name_part_and_row():
    parts = scene()
    drawn = sx.render(parts, CAMERA, outputs=("parts", "alpha", "contributors"))
    assert drawn.parts.shape == (40, 48, 2)
    assert_allclose(drawn.parts.sum(axis=2), drawn.alpha, atol=1e-5)
    part, row = parts.part_of(drawn.contributors.indices)
    for i, own in enumerate((WHEEL, BODY)):
        here = np.where(part == i, drawn.contributors.weights, 0).sum(axis=2)
        assert (here <= np.asarray(drawn.parts[..., i]) + 1e-5).all()
        assert here.max() > 0.5
        assert row[part == i].min() >= 0
        assert row[part == i].max() < len(own)
    nothing = drawn.contributors.indices < 0
    assert_array_equal(part[nothing], -1)


ASKED = ("rgb", "alpha", "parts", "median_depth", "median_surface_depth")


@pytest.fixture(params=NAMES)
def surveyor(request):
    """Backends with a kernel that blends and selects at once; the others have the two walks alone."""
    found = kernels(request.param)
    if found.survey is None:
        pytest.skip("it blends and selects in two walks")
    return found


def apart(kernels):
    """The same kernels without the one that blends and selects at once."""
    return replace(kernels, name=f"{kernels.name}, apart", survey=None)


def test_colour_parts_and_median_of_one_walk_are_those_of_two(surveyor):
    parts = scene(color=MAP)
    for outputs in (ASKED, ("rgb", "depth", "parts"), ("parts",), ("alpha", "median_depth")):
        once = sx.render(parts, CAMERA, outputs=outputs, backend=surveyor)
        twice = sx.render(parts, CAMERA, outputs=outputs, backend=apart(surveyor))
        for name in outputs:
            assert_array_equal(once.images[name], twice.images[name], err_msg=name)


def test_a_batch_of_scenes_is_surveyed_as_each_by_itself(backend):
    moves = jnp.array([[0.5, -0.3, 0.4], [-0.4, 0.2, 0.0], [0.0, 0.3, -0.5]])

    def seen(move):
        moved = scene(pose=replace(AWAY, translation=move))
        return sx.render(moved, CAMERA, outputs=ASKED, backend=backend).images

    together = jax.vmap(seen)(moves)
    for i, move in enumerate(moves):
        for name, image in seen(move).items():
            assert_allclose(together[name][i], image, atol=1e-5, err_msg=name)


def test_the_survey_has_the_derivatives_of_the_rasterizer(surveyor):
    def total(move, kernels):
        moved = scene(pose=replace(AWAY, translation=move))
        drawn = sx.render(moved, CAMERA, outputs=ASKED, backend=kernels)
        weighted = drawn.parts * jnp.array([1.0, -2.0])[None, None]
        return jnp.sum(drawn.rgb**2) + jnp.sum(weighted) + jnp.sum(drawn.median_surface_depth)

    move = jnp.asarray(AWAY.translation, jnp.float32)
    once, twice = (jax.grad(total)(move, kernels) for kernels in (surveyor, apart(surveyor)))
    assert np.abs(twice).min() > 0.1
    assert_allclose(once, twice, rtol=1e-5)


def test_the_native_backend_asks_its_survey_only_for_what_it_stands_for():
    kernels = backends.resolve("cpu")
    splats = sx.rendering.project(scene(), CAMERA)
    assert kernels.in_one_walk(splats, 3, 2) is kernels.survey
    assert kernels.in_one_walk(splats, 5, 2) is None
    mine = replace(kernels, select=lambda splats, count: kernels.select(splats, count))
    assert mine.in_one_walk(splats, 3, 2) is None
