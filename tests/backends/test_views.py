"""Batches of views of one scene on the CPU: one native call, which draws what kernels for one view draw."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians
from splatax.backends import cpu
from splatax.low_pass import Antialiasing, Dilation
from splatax.rendering import render

pytestmark = pytest.mark.skipif(
    cpu.BEST.why_unavailable() is not None, reason=f"no native library: {cpu.BEST.why_unavailable()}"
)
SCENE = random_gaussians(3, n=700, degree=2, spread=2.0, scale=(0.01, 0.2))
PLACES = [(0.0, 0.0, -4.0), (0.3, 0.1, 0.2), (-1.0, 0.5, 1.0), (2.5, 0.0, 2.5), (0.0, 9.0, 9.0)]
CAMERAS = [
    camera_at(position=place, target=(0.4, 0.1, 0.6), size=(37, 21), focal=20.0 + i)
    for i, place in enumerate(PLACES)
]
STACKED = jax.tree.map(lambda *leaves: jnp.stack(leaves), *CAMERAS)
OUTPUTS = ("rgb", "alpha", "depth")


def one(scene, camera, backend=cpu.BEST, low_pass=None):
    drawn = render(scene, camera, outputs=OUTPUTS, backend=backend, low_pass=low_pass)
    return drawn.rgb, drawn.alpha, drawn.depth


def loss(scene, camera, backend=cpu.BEST):
    rgb, alpha, depth = one(scene, camera, backend)
    weights = jnp.linspace(-1, 1, rgb.shape[1], dtype=jnp.float32)
    return (
        jnp.sum(jnp.square(rgb) * weights[None, :, None])
        + jnp.sum(alpha * weights[None])
        + 0.1 * jnp.sum(depth)
    )


def total(scene, cameras, backend=cpu.BEST):
    return jnp.sum(jax.vmap(lambda camera: loss(scene, camera, backend))(cameras))


def summed(scene, cameras):
    """The same, by a loop over single views."""
    views = [jax.tree.map(lambda leaf, i=i: leaf[i], cameras) for i in range(len(PLACES))]
    return sum(loss(scene, view) for view in views)


def assert_close(found, expected, tolerance=2e-5):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(a, b, atol=tolerance * max(float(np.abs(b).max()), 1))


@pytest.fixture
def symbols(monkeypatch):
    """The native functions that are called, in order."""
    called = []
    original = cpu.Build.call

    def record(self, symbol, *arguments, **options):
        called.append(symbol.removeprefix("splatax_"))
        return original(self, symbol, *arguments, **options)

    monkeypatch.setattr(cpu.Build, "call", record)
    return called


@pytest.mark.parametrize("low_pass", [Dilation(), Antialiasing()])
@pytest.mark.parametrize("order", ["depth", "distance"])
def test_a_batch_of_views_is_the_views_one_by_one(low_pass, order):
    scene = replace(SCENE, order=order)
    together = jax.vmap(lambda camera: one(scene, camera, low_pass=low_pass))(STACKED)
    for i, camera in enumerate(CAMERAS):
        for batch, single in zip(together, one(scene, camera, low_pass=low_pass), strict=True):
            assert_allclose(batch[i], single, atol=2e-6 * max(float(np.abs(single).max()), 1))


def test_the_order_of_a_batch_changes_its_images_and_gradients():
    far = replace(SCENE, order="distance")
    near = jax.grad(total)(SCENE, STACKED)
    found = jax.grad(total)(far, STACKED)
    assert_close(found, jax.grad(summed)(far, STACKED), 1e-4)
    assert np.abs(found.sh - near.sh).max() > 1e-3


def test_a_batch_and_its_gradient_are_one_native_call_each():
    program = jax.jit(lambda cameras: jax.grad(total)(SCENE, cameras)).lower(STACKED).compile().as_text()
    assert re.findall(r'custom_call_target="\w*(scene_[a-z]+)', program) == [
        "scene_forward",
        "scene_backward",
    ]


def test_a_batch_of_colours_blends_no_depths(symbols):
    views = jax.vmap(lambda camera: render(SCENE, camera, outputs=("rgb",), backend="cpu").rgb)
    assert "x37x4xf32" not in jax.jit(views).lower(STACKED).as_text()
    assert symbols == ["scene_forward"]


def test_the_gradient_of_a_batch_is_the_sum_of_those_of_its_views():
    found = jax.grad(total, (0, 1))(SCENE, STACKED)
    assert_close(found, jax.grad(summed, (0, 1))(SCENE, STACKED), 1e-4)


SIZES = [(37, 21), (40, 24), (25, 17), (1, 24), (16, 16)]
ON_CANVAS = [
    camera_at(position=place, target=(0.4, 0.1, 0.6), size=size, focal=20.0).on_canvas(40, 24)
    for place, size in zip(PLACES, SIZES, strict=True)
]
STACKED_ON_CANVAS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *ON_CANVAS)


def loss_in_frame(scene, camera):
    """A loss of the pixels that are defined."""
    rgb, alpha, depth = one(scene, camera)
    y, x = jnp.mgrid[: camera.height, : camera.width].astype(jnp.float32)
    inside = (x < camera.frame[0]) & (y < camera.frame[1])
    return jnp.sum(jnp.where(inside, jnp.sum(jnp.square(rgb), axis=-1) + alpha + 0.1 * depth, 0))


def test_a_batch_of_cameras_on_a_canvas_is_the_cameras_one_by_one(symbols):
    together = jax.vmap(lambda camera: one(SCENE, camera))(STACKED_ON_CANVAS)
    assert symbols == ["scene_forward"]
    for i, (camera, (width, height)) in enumerate(zip(ON_CANVAS, SIZES, strict=True)):
        for batch, single in zip(together, one(SCENE, camera), strict=True):
            expected = single[:height, :width]
            tolerance = 4e-6 * max(float(np.abs(expected).max()), 1)  # without AVX-512, 2.4e-6 were seen
            assert_allclose(batch[i, :height, :width], expected, atol=tolerance)


def test_the_gradient_of_a_batch_on_a_canvas_is_the_sum_of_those_of_its_cameras():
    def total(scene, cameras):
        return jnp.sum(jax.vmap(loss_in_frame, (None, 0))(scene, cameras))

    def looped(scene, cameras):
        views = [jax.tree.map(lambda leaf, i=i: leaf[i], cameras) for i in range(len(SIZES))]
        return sum(loss_in_frame(scene, view) for view in views)

    (d_scene, d_cameras), (expected, each) = (
        jax.grad(f, (0, 1))(SCENE, STACKED_ON_CANVAS) for f in (total, looped)
    )
    assert_close(d_scene, expected, 1e-4)
    assert_close(d_cameras, each, 1e-4)
    assert_array_equal(d_cameras.frame, 0)


@pytest.mark.parametrize("size", [jnp.nan, jnp.inf, 1e9, -5.0, 0.0])
def test_a_frame_that_is_none_leaves_the_other_views_as_they_are(size):
    frames = STACKED_ON_CANVAS.frame.at[1].set(size)
    odd = replace(STACKED_ON_CANVAS, frame=frames)
    expected, images = (
        jax.vmap(lambda camera: one(SCENE, camera))(cameras) for cameras in (STACKED_ON_CANVAS, odd)
    )
    for whole, image in zip(expected, images, strict=True):
        assert_array_equal(np.delete(image, 1, axis=0), np.delete(whole, 1, axis=0))
        assert np.isfinite(image).all()


@pytest.mark.parametrize("backend", [cpu.kernels(threads=n) for n in (1, 2, 3)])
def test_a_batch_has_the_same_bits_for_any_number_of_threads(backend):
    expected = jax.value_and_grad(total, (0, 1))(SCENE, STACKED)
    found = jax.value_and_grad(total, (0, 1))(SCENE, STACKED, backend)
    jax.tree.map(assert_array_equal, found, expected)


def test_a_batch_drawn_in_rounds_is_the_same():
    few = cpu.kernels(max_pairs=150)
    assert_close(
        jax.value_and_grad(total, (0, 1))(SCENE, STACKED, few),
        jax.value_and_grad(total, (0, 1))(SCENE, STACKED),
        1e-4,
    )


def moving(count=60):
    """A small scene with two cameras, and a direction in all of their numbers."""
    point = jax.tree.map(lambda leaf: leaf[:count], SCENE), jax.tree.map(lambda leaf: leaf[:2], STACKED)
    rng = np.random.default_rng(0)
    return point, jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape) * 0.01, jnp.float32), point)


def total_of_copies(scene, cameras):
    """The same as `total`, with a copy of the scene for each camera: by kernels for single views."""
    copies = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), scene)
    return jnp.sum(jax.vmap(loss)(copies, cameras))


def test_forward_mode_of_a_batch():
    point, direction = moving()
    found = jax.jit(lambda *at: jax.jvp(total, *at))(point, direction)
    assert_close(found, jax.jit(lambda *at: jax.jvp(total_of_copies, *at))(point, direction), 2e-5)


@pytest.mark.slow
def test_second_derivatives_of_a_batch():
    point, direction = moving()
    found, expected = (
        jax.jit(lambda *at, f=f: jax.jvp(jax.grad(f, (0, 1)), *at))(point, direction)
        for f in (total, total_of_copies)
    )
    assert_close(found, expected, 2e-4)


def test_views_of_several_scenes_and_batches_of_batches():
    other = random_gaussians(4, n=700, degree=2, spread=2.0)
    scenes = jax.tree.map(lambda a, b: jnp.stack([a, b]), SCENE, other)
    pairs = jax.tree.map(lambda leaf: leaf[:2], STACKED)
    images = jax.vmap(lambda scene, camera: one(scene, camera)[0])(scenes, pairs)
    assert_allclose(images[1], one(other, CAMERAS[1])[0], atol=2e-6)
    grid = jax.vmap(lambda scene: jax.vmap(lambda camera: one(scene, camera)[0])(pairs))(scenes)
    assert_allclose(grid[1, 0], one(other, CAMERAS[0])[0], atol=2e-6)
    gradient = jax.grad(lambda g: jnp.sum(jax.vmap(lambda scene: total(scene, pairs))(g)))(scenes)
    expected = jax.grad(total)(other, pairs)
    assert_close(jax.tree.map(lambda leaf: leaf[1], gradient), expected, 1e-4)
    fours = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), pairs)
    again = jax.vmap(jax.vmap(lambda camera: one(SCENE, camera)[0]))(fours)
    assert_allclose(again[1, 1], one(SCENE, CAMERAS[1])[0], atol=2e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, 40.0, -200.0, 0.0])
@pytest.mark.parametrize("field", ["means", "quats", "log_scales", "opacity_logits"])
def test_absurd_gaussians_are_seen_in_a_batch_as_they_are_alone(field, value):
    array = np.array(getattr(SCENE, field))
    array[5::90] = value
    scene = replace(SCENE, **{field: jnp.asarray(array)})
    together = jax.vmap(lambda camera: one(scene, camera))(STACKED)
    for i, camera in enumerate(CAMERAS):
        for batch, single in zip(together, one(scene, camera), strict=True):
            assert_allclose(batch[i], single, atol=2e-6 * max(float(np.abs(single).max()), 1))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.grad(total)(scene, STACKED)))


def test_a_rasterizer_of_ones_own_draws_batches_too():
    def nothing(splats, channels):
        image, alpha = cpu.BEST.composite(splats, channels)
        return 0 * image, alpha

    backend = replace(cpu.BEST, name="mine", composite=nothing)
    assert not np.any(jax.vmap(lambda camera: one(SCENE, camera, backend)[0])(STACKED))
