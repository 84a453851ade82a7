"""Tests of the CUDA backend only, on an emulated GPU: order of threads, rounds, malformed input."""

import ctypes.util
import importlib.util
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import emulated
from scenes import camera_at, random_gaussians, random_splats
from splatax.backends import reference
from splatax.backends.cuda import nvidia
from splatax.backends.cuda.library import load
from splatax.low_pass import Dilation
from splatax.moving import Moments, Rule, Step
from splatax.training.optimizer import LearningRates

pytestmark = pytest.mark.skipif(
    emulated.why_unavailable() is not None, reason=str(emulated.why_unavailable())
)
SCENE = random_splats(7, n=300, size=(40, 33), sigma=(1, 9))
ORDERS = (1, 2, 3)  # besides that of the threads' numbers


@pytest.fixture(params=ORDERS)
def other_order(request):
    """Threads and blocks take turns in another order, when it is called."""
    yield lambda: emulated.set_order(request.param)
    emulated.set_order(0)


@partial(jax.jit, static_argnames="backend")
def image_and_gradient(scene, backend, channels=None):
    def objective(scene, channels):
        image, alpha = backend.composite(scene, channels)
        weights = jnp.asarray(np.random.default_rng(0).normal(size=image.shape), jnp.float32)
        return jnp.sum(image * weights) + jnp.sum(alpha * weights[..., 0]), (image, alpha)

    channels = scene.colors if channels is None else channels
    (_, image), gradient = jax.value_and_grad(objective, (0, 1), has_aux=True)(scene, channels)
    return [*image, *jax.tree.leaves(gradient)]


def watched(scene):
    return replace(scene, pull=jnp.zeros_like(scene.means2d))


def same_bits(compute, other_order):
    first = compute()
    other_order()
    for a, b in zip(first, compute(), strict=True):
        assert_array_equal(a, b)


# --- the order of threads ---


@pytest.mark.slow
def test_the_rasterizer_gives_the_same_bits_in_any_order_of_threads(other_order):
    same_bits(lambda: image_and_gradient(watched(SCENE), emulated.kernels()), other_order)


@pytest.mark.slow
def test_many_channels_and_rounds_give_the_same_bits_in_any_order_of_threads(other_order):
    channels = jnp.asarray(np.random.default_rng(1).normal(size=(300, 6)), jnp.float32)
    in_rounds = emulated.kernels(max_pairs=300)
    same_bits(lambda: image_and_gradient(SCENE, in_rounds, channels), other_order)


def test_projection_and_loss_give_the_same_bits_in_any_order_of_threads(other_order):
    gaussians, camera, kernels = random_gaussians(n=300, degree=2), camera_at(), emulated.kernels()
    image, photo = jnp.asarray(np.random.default_rng(0).uniform(size=(2, 30, 41, 3)), jnp.float32)

    def objective(gaussians, camera, image):
        splats = kernels.project(gaussians, camera, Dilation())
        shape = jnp.sum(splats.means2d) + jnp.sum(splats.sqrt_conics * splats.opacities[:, None])
        return shape + jnp.sum(splats.colors) + kernels.photometric(image, photo, 0.2)

    gradients = jax.jit(jax.value_and_grad(objective, (0, 1, 2)))
    same_bits(lambda: jax.tree.leaves(gradients(gaussians, camera, image)), other_order)


# --- a training step of the rows ---


def rows_to_move(n=96):
    """A scene of faint and of clear Gaussians, some of them at rest, and the numbers of a step with noise."""
    rng = np.random.default_rng(3)
    gaussians = random_gaussians(n=n, degree=1)
    gaussians = replace(gaussians, opacity_logits=jnp.linspace(-8, 3, n, dtype=jnp.float32))

    def numbers(scale):
        return jax.tree.map(
            lambda leaf: jnp.asarray(rng.normal(0, scale, leaf.shape), jnp.float32).at[20:60].set(0),
            gaussians,
        )

    gradients, mean, square = numbers(1e-3), numbers(1e-3), jax.tree.map(jnp.abs, numbers(1e-6))
    step = Step(
        rates=LearningRates().at(jnp.float32(0.5), jnp.linspace(1.0, 2.0, n, dtype=jnp.float32), 4),
        free=jnp.ones(4, bool),
        good=jnp.asarray(True),
        steps=jnp.int32(3),
        living=jnp.int32(n),
        extent=jnp.float32(3),
        keys=jax.random.key_data(jax.random.split(jax.random.key(5), n // 32)),
    )
    return (gaussians, gradients, Moments(mean, square)), step


MOVE = Rule(0.9, 0.999, 1e-15, opacity=0.3, scale=0.7, noise=5e5)


def test_a_step_of_the_rows_gives_the_same_bits_in_any_order_of_threads(other_order):
    rows, step = rows_to_move()
    same_bits(lambda: jax.tree.leaves(emulated.kernels().move(*rows, step, MOVE, 32)), other_order)


def test_a_row_moves_alike_in_any_part_of_a_scene():
    rows, step = rows_to_move()
    whole = emulated.kernels().move(*rows, step, MOVE, 32)
    for block in range(3):
        own = slice(32 * block, 32 * block + 32)
        part = jax.tree.map(lambda leaf, own=own: leaf[own], rows)
        rates = replace(step.rates, means=step.rates.means[own])
        its_step = step._replace(rates=rates, keys=step.keys[block : block + 1])
        alone = emulated.kernels().move(*part, its_step, MOVE, 32)
        for a, b in zip(*map(jax.tree.leaves, (whole, alone)), strict=True):
            assert_array_equal(a[own], b)


@pytest.mark.parametrize("donated", [True, False])
def test_a_step_is_made_in_the_memory_of_donated_arrays_and_spoils_no_others(donated):
    (gaussians, gradients, moments), step = rows_to_move()
    expected = emulated.kernels().move(gaussians, gradients, moments, step, MOVE, 32)
    move = jax.jit(
        partial(emulated.kernels().move, rule=MOVE, block=32), donate_argnums=(0, 2) if donated else ()
    )
    before = jax.tree.map(jnp.copy, (gaussians, moments))
    places = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(before)]
    found = jax.tree.leaves(move(before[0], gradients, before[1], step))
    assert ([leaf.unsafe_buffer_pointer() for leaf in found] == places) is donated
    for a, b in zip(found, jax.tree.leaves(expected), strict=True):
        assert_array_equal(a, b)
    if not donated:
        for a, b in zip(*map(jax.tree.leaves, (before, (gaussians, moments))), strict=True):
            assert_array_equal(a, b)


# --- rounds ---


@pytest.mark.parametrize("channels", [3, 6])
def test_rounds_change_nothing_that_is_drawn(channels):
    values = jnp.asarray(np.random.default_rng(1).normal(size=(300, channels)), jnp.float32)
    at_once = image_and_gradient(SCENE, emulated.kernels(), values)
    in_rounds = image_and_gradient(SCENE, emulated.kernels(max_pairs=200), values)
    assert_array_equal(in_rounds[0], at_once[0])
    assert_array_equal(in_rounds[1], at_once[1])
    for a, b in zip(in_rounds, at_once, strict=True):
        assert_allclose(a, b, atol=2e-5 * max(np.abs(b).max(), 1))


def test_pull_does_not_depend_on_rounds():
    at_once = image_and_gradient(watched(SCENE), emulated.kernels())
    in_rounds = image_and_gradient(watched(SCENE), emulated.kernels(max_pairs=200))
    for a, b in zip(in_rounds, at_once, strict=True):
        assert_allclose(a, b, atol=2e-5 * max(np.abs(b).max(), 1))


def test_splats_that_touch_every_tile_fit_into_the_smallest_round():
    everywhere = random_splats(3, n=20, size=(40, 33), sigma=(200, 300), opacity=(0.05, 0.2))
    expected = reference.composite(everywhere, everywhere.colors)
    for actual, wanted in zip(
        emulated.kernels(max_pairs=1).composite(everywhere, everywhere.colors), expected, strict=True
    ):
        assert_allclose(actual, wanted, atol=2e-6)


# --- input that nobody should pass ---


def test_pull_of_more_channels_than_are_drawn_at_once_is_refused():
    with pytest.raises(ValueError, match="`pull` for up to 4 channels, not for 6"):
        emulated.kernels().composite(watched(SCENE), jnp.ones((300, 6)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e-42, 3e38, -3e38, 0.0])
@pytest.mark.parametrize("field", ["means2d", "sqrt_conics", "depths", "extents", "opacities"])
def test_one_absurd_splat_never_crashes_nor_leaves_the_others_undrawn(field, value):
    array = np.array(getattr(SCENE, field))
    array[100] = value
    absurd = replace(SCENE, **{field: jnp.asarray(array)})
    image, alpha, *gradients = image_and_gradient(absurd, emulated.kernels())
    assert image.shape == (33, 40, 3)
    assert np.isfinite(alpha).all()
    assert all(np.isfinite(np.delete(g, 100, axis=0)).all() for g in gradients if g.shape[:1] == (300,))


@pytest.mark.parametrize("size", [(1, 1), (1, 2000), (2000, 1), (257, 3)])
def test_images_of_extreme_shapes(size):
    scene = random_splats(n=40, size=size)
    expected = reference.composite(scene, scene.colors)
    actual = emulated.kernels().composite(scene, scene.colors)
    for a, b in zip(actual, expected, strict=True):
        assert_allclose(a, b, atol=2e-6)


def call(symbol, results, shapes, **options):
    library = emulated.kernels().composite.keywords["library"]
    return library.call(symbol, results, [jnp.ones(shape) for shape in shapes], **options)


SPLATS = [(5, 2), (5, 3), (5,), (5, 2), (5,), (5, 3)]
GAUSSIANS = [(5, 3), (5, 4), (5, 3), (5,), (5, 4, 3), (19,)]
PROJECTED = [(5, 2), (5, 3), (5,), (5, 2), (5, 3), (5,)]


@pytest.mark.parametrize("wrong", range(6))
def test_arrays_of_splats_that_do_not_fit_together_are_refused_before_they_are_read(wrong):
    shapes = list(SPLATS)
    shapes[wrong] = (4, *shapes[wrong][1:])
    results = [(8, 9, 3), (8, 9), jax.ShapeDtypeStruct((0,), jnp.uint32), (0,)]
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"splatax: rasterize: .* has shape"):
        call("splatax_cuda_rasterize", results, shapes, max_pairs=np.int64(100))


def test_lists_of_another_size_than_the_kernels_write_are_refused():
    results = [(8, 9, 3), (8, 9), jax.ShapeDtypeStruct((7,), jnp.uint32), (1024,)]
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"words has shape \[7\], not"):
        call("splatax_cuda_rasterize", results, SPLATS, max_pairs=np.int64(100))


@pytest.mark.parametrize("wrong", range(6))
def test_arrays_of_gaussians_that_do_not_fit_together_are_refused_before_they_are_read(wrong):
    shapes = list(GAUSSIANS)
    shapes[wrong] = (4, *shapes[wrong][1:])
    options = {"width": np.int64(9), "height": np.int64(8), "fades": np.int64(0)}
    floats = {"variance": np.float32(0.3), "least_fade": np.float32(0)}
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"splatax: project: .* has shape"):
        call("splatax_cuda_project", PROJECTED, shapes, **options, **floats)


def test_a_photo_of_another_size_is_refused_before_it_is_read():
    with pytest.raises(jax.errors.JaxRuntimeError, match="photo has shape"):
        call(
            "splatax_cuda_photometric",
            [(), (8, 9, 3)],
            [(8, 9, 3), (8, 8, 3)],
            ssim_weight=np.float32(0.2),
        )


FIELDS = [(5, 3), (5, 4), (5, 3), (5,), (5, 4, 3)]
STEP = [(15,), (5,), (4,), (4,)]


def call_move(shapes, keys):
    library = emulated.kernels().composite.keywords["library"]
    arrays = [*(jnp.ones(shape) for shape in shapes), keys]
    return library.call("splatax_cuda_move", 3 * FIELDS, arrays, block=np.int64(8))


@pytest.mark.parametrize("wrong", range(24))
def test_arrays_of_a_step_that_do_not_fit_together_are_refused_before_they_are_read(wrong):
    shapes = [*(4 * FIELDS), *STEP]
    shapes[wrong] = (3, *shapes[wrong][1:])
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"splatax: move: .* has shape"):
        call_move(shapes, jnp.zeros((1, 2), jnp.uint32))


@pytest.mark.parametrize(
    ("keys", "message"),
    [(jnp.zeros((2, 2), jnp.uint32), "keys has shape"), (jnp.zeros((1, 2)), "array 24 is .* another type")],
)
def test_keys_of_another_kind_are_refused(keys, message):
    with pytest.raises(jax.errors.JaxRuntimeError, match=f"splatax: move: {message}"):
        call_move([*(4 * FIELDS), *STEP], keys)


# --- the library of users ---


def test_the_drivers_functions_are_declared_as_in_nvidias_header(tmp_path):
    spec = importlib.util.find_spec("nvidia")
    folders = (
        [Path(root) / "cuda_runtime" / "include" for root in spec.submodule_search_locations] if spec else []
    )
    folders = [folder for folder in folders if (folder / "cuda.h").exists()]
    if not folders:
        pytest.skip("cuda.h is not installed: pip install nvidia-cuda-runtime-cu12")
    source = emulated.NATIVE / "emulation" / "declarations.cc"
    emulated.compile([source], tmp_path / "declarations.o", "-c", "-isystem", str(folders[0]))


@pytest.mark.skipif(not nvidia.LIBRARY.path.exists(), reason="the library for CUDA was not built")
def test_the_library_loads_without_a_driver_and_says_what_is_missing():
    library = load(nvidia.LIBRARY.path)
    assert b"cannot be opened: no-such-driver.so" in library.splatax_cuda_open(b"no-such-driver.so")
    other = ctypes.util.find_library("m").encode()
    assert b"has no function cuInit; a driver for CUDA 12" in library.splatax_cuda_open(other)
    assert b"was not opened" in library.splatax_cuda_load(90, b"")
