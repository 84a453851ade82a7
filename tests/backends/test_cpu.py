"""Tests of the native rasterizer only: threads, rounds, and malformed input."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians, random_splats
from splatax.along_rays import squared_distances
from splatax.backends import cpu, reference
from splatax.backends.cpu import library, slanted
from splatax.low_pass import AlongRays
from splatax.rendering import project, render
from splatax.splats import MIN_ALPHA
from splatax.surfaces import pixel_centers

pytestmark = pytest.mark.skipif(
    cpu.BEST.why_unavailable() is not None, reason=f"no native library: {cpu.BEST.why_unavailable()}"
)
NOT_BUILT = "there is no build of the native library for baseline"
SCENE = random_splats(7, n=600, size=(70, 53), sigma=(1, 12))


def along_rays(flat=True, n=400):
    """Discs, or Gaussians, of all shapes and sizes, near the camera too."""
    gaussians = random_gaussians(n=n, degree=0, spread=1.5, scale=(0.005, 0.3))
    if flat:
        gaussians = replace(gaussians, log_scales=gaussians.log_scales.at[:, 2].set(-jnp.inf))
    camera = camera_at((0.3, -0.2, -2.0), size=(70, 53), focal=60.0)
    return project(gaussians, camera, low_pass=AlongRays(), backend="reference")


@partial(jax.jit, static_argnames="backend")
def image_and_gradient(scene, backend=cpu.BEST, channels=None):
    def objective(scene, channels):
        image, alpha = backend.composite(scene, channels)
        weights = jnp.asarray(np.random.default_rng(0).normal(size=image.shape), jnp.float32)
        return jnp.sum(image * weights) + jnp.sum(alpha * weights[..., 0]), (image, alpha)

    channels = scene.colors if channels is None else channels
    (_, image), gradient = jax.value_and_grad(objective, (0, 1), has_aux=True)(scene, channels)
    return [*image, *jax.tree.leaves(gradient)]


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("width", [3, 6, 70])
def test_any_number_of_threads_gives_the_same_bits(threads, width):
    channels = jnp.asarray(np.random.default_rng(1).normal(size=(600, width)), jnp.float32)
    everything = image_and_gradient(SCENE, cpu.BEST, channels)
    with_some = image_and_gradient(SCENE, cpu.kernels(threads=threads), channels)
    for a, b in zip(everything, with_some, strict=True):
        assert_array_equal(a, b)


@pytest.mark.parametrize("width", [3, 9])
def test_splats_along_rays_have_the_same_bits_on_any_number_of_threads(width):
    splats = along_rays()
    channels = jnp.asarray(np.random.default_rng(1).normal(size=(400, width)), jnp.float32)
    everything = image_and_gradient(splats, cpu.BEST, channels)
    for threads in (1, 3):
        for a, b in zip(
            everything, image_and_gradient(splats, cpu.kernels(threads=threads), channels), strict=True
        ):
            assert_array_equal(a, b)


@pytest.mark.parametrize("flat", [False, True])
def test_hulls_hold_the_pixels_of_splats_along_rays_and_little_more(flat):
    splats = along_rays(flat)
    pixels = pixel_centers(70, 53, jnp.dtype("float32")).reshape(-1, 2)
    centers, roots, extents = slanted.hulls_of(splats)
    areas = []
    for i in np.flatnonzero(np.asarray(splats.extents[:, 0]) > 0):
        shapes = (rows[i][None] for rows in (splats.sqrt_conics, splats.slants))
        shapes = (jnp.broadcast_to(row, (len(pixels), row.shape[1])) for row in shapes)
        q = squared_distances(pixels - splats.means2d[i][None], *shapes)
        drawn = np.asarray(splats.opacities[i] * jnp.exp(-q / 2)) >= MIN_ALPHA
        dx, dy = np.asarray(pixels - centers[i][None]).T
        u, v, w = np.asarray(roots[i])
        reach = 2 * np.log(float(splats.opacities[i]) / MIN_ALPHA)
        inside = (u * dx + v * dy) ** 2 + (w * dy) ** 2 <= 1.001 * reach
        inside &= (np.abs(np.stack([dx, dy])) <= np.asarray(extents[i])[:, None] * 1.001).all(axis=0)
        assert (inside | ~drawn).all()
        areas.append((drawn.sum(), inside.sum()))
    drawn, inside = np.sum(areas, axis=0)
    assert inside < 3 * drawn


@pytest.mark.parametrize("other", [cpu.kernels(threads=1), cpu.kernels(max_pairs=100)])
def test_pull_depends_neither_on_threads_nor_on_rounds(other):
    watched = replace(SCENE, pull=jnp.zeros_like(SCENE.means2d))
    for a, b in zip(image_and_gradient(watched, other), image_and_gradient(watched), strict=True):
        assert_allclose(a, b, atol=2e-5 * max(np.abs(b).max(), 1))


def test_pull_of_more_channels_than_are_drawn_at_once_is_refused():
    watched = replace(SCENE, pull=jnp.zeros_like(SCENE.means2d))
    with pytest.raises(ValueError, match="`pull` for up to 16 channels, not for 17"):
        cpu.BEST.composite(watched, jnp.ones((600, 17)))


@pytest.mark.parametrize(("rays", "width"), [(False, 3), (False, 21), (True, 3), (True, 9)])
def test_rounds_change_nothing_that_is_drawn(rays, width):
    splats = along_rays() if rays else SCENE
    channels = jnp.asarray(np.random.default_rng(1).normal(size=(len(splats.depths), width)), jnp.float32)
    at_once = image_and_gradient(splats, channels=channels)
    in_rounds = image_and_gradient(splats, cpu.kernels(max_pairs=100), channels)
    assert_array_equal(in_rounds[0], at_once[0])
    assert_array_equal(in_rounds[1], at_once[1])
    for a, b in zip(in_rounds, at_once, strict=True):
        assert_allclose(a, b, atol=2e-5 * max(np.abs(b).max(), 1))


@pytest.mark.parametrize("pulled", [False, True])
def test_a_gradient_has_the_same_bits_whether_or_not_the_lists_of_its_image_are_kept(pulled):
    opaque = replace(
        SCENE, opacities=jnp.linspace(0.01, 1, 600, dtype=jnp.float32)
    )  # many pixels are finished
    pull = jnp.zeros_like(SCENE.means2d) if pulled else None
    image, pull_back = jax.vjp(
        lambda splats: cpu.BEST.composite(splats, splats.colors), replace(opaque, pull=pull)
    )
    assert np.mean(image[1] > 0.999) > 0.2
    weights = jnp.asarray(np.random.default_rng(0).normal(size=image[0].shape), jnp.float32)
    kept = pull_back((weights, weights[..., 0]))
    again = pull_back((weights, weights[..., 0]))  # the first call has used them up
    for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(again), strict=True):
        assert_array_equal(a, b)


def test_calls_from_several_python_threads_do_not_disturb_each_other():
    scenes = [random_splats(seed, n=300) for seed in range(4)]
    expected = [image_and_gradient(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as executor:
        for _ in range(5):
            for results, alone in zip(executor.map(image_and_gradient, scenes), expected, strict=True):
                for a, b in zip(results, alone, strict=True):
                    assert_array_equal(a, b)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e-42, 3e38, -3e38, 0.0])
@pytest.mark.parametrize("field", ["means2d", "sqrt_conics", "depths", "extents", "opacities"])
def test_one_absurd_splat_never_crashes_nor_leaves_the_others_undrawn(field, value):
    array = np.array(getattr(SCENE, field))
    array[100] = value
    image, alpha, *gradients = image_and_gradient(replace(SCENE, **{field: jnp.asarray(array)}))
    assert image.shape == (53, 70, 3)
    assert np.isfinite(alpha).all()
    assert all(np.isfinite(np.delete(g, 100, axis=0)).all() for g in gradients if g.shape[:1] == (600,))


@pytest.mark.parametrize("size", [(1, 1), (1, 5000), (5000, 1), (257, 3)])
def test_images_of_extreme_shapes(size):
    scene = random_splats(n=40, size=size)
    expected = reference.composite(scene, scene.colors)
    for actual, wanted in zip(cpu.BEST.composite(scene, scene.colors), expected, strict=True):
        assert_allclose(actual, wanted, atol=2e-6)


@pytest.mark.slow
def test_a_million_splats_in_one_pixel():
    scene = random_splats(n=1_000_000, size=(1, 1), sigma=(0.6, 2), opacity=(0.004, 0.006))
    _, alpha, *gradients = image_and_gradient(scene)
    assert 0.9 < float(alpha[0, 0]) <= 1
    assert all(np.isfinite(g).all() for g in gradients)


def test_it_is_refused_by_name_where_the_machine_cannot_run_it(monkeypatch):
    monkeypatch.setattr(library, "best_instructions", lambda: "baseline")
    assert "no avx512" in cpu.AVX512.why_unavailable()
    assert cpu.BASELINE.why_unavailable() in (None, NOT_BUILT)


def test_a_build_that_an_installation_lacks_is_named(monkeypatch, tmp_path):
    shutil.copy(library.library_path(library.CHOICE), tmp_path)
    monkeypatch.setattr(library, "FOLDER", tmp_path)
    assert cpu.BASELINE.why_unavailable() == NOT_BUILT


def test_an_installation_without_the_library_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setattr(library, "FOLDER", tmp_path)
    assert "install a C++" in cpu.BEST.why_unavailable()


def rates(scene, channels, backend):
    """Derivatives of the image along seven directions, more than one walk follows."""
    rng = np.random.default_rng(3)
    moving = (scene.means2d, scene.sqrt_conics, scene.opacities, channels)
    directions = [jnp.asarray(rng.normal(size=(7, *array.shape)) * 0.01, jnp.float32) for array in moving]

    def image(means2d, sqrt_conics, opacities, channels):
        moved = replace(scene, means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities)
        return backend.composite(moved, channels)

    return jax.jit(jax.vmap(lambda *along: jax.jvp(image, moving, along)[1]))(*directions)


@pytest.mark.parametrize("width", [3, 21])
def test_forward_mode_depends_neither_on_threads_nor_on_rounds(width):
    channels = jnp.asarray(np.random.default_rng(1).normal(size=(600, width)), jnp.float32)
    expected = rates(SCENE, channels, cpu.BEST)
    for a, b in zip(rates(SCENE, channels, cpu.kernels(threads=1)), expected, strict=True):
        assert_array_equal(a, b)
    for a, b in zip(rates(SCENE, channels, cpu.kernels(max_pairs=100)), expected, strict=True):
        assert_allclose(a, b, atol=2e-5 * np.abs(b).max())


@pytest.mark.parametrize("count", [1, 6, 8])
@pytest.mark.parametrize("width", [1, 3, 21])
@pytest.mark.parametrize("size", [(33, 20), (1, 1)])
def test_derivatives_along_many_directions_are_those_along_each(size, width, count):
    rng = np.random.default_rng(4)
    scenes = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(random_splats(k, n=60, size=size) for k in range(2))
    )
    channels = jnp.asarray(rng.normal(size=(60, width)), jnp.float32)
    pushes = jnp.asarray(rng.normal(size=(count, 60, 2)), jnp.float32)

    def moved(scene, steps):
        means2d = scene.means2d + jnp.tensordot(steps, pushes, 1)
        return jnp.concatenate(
            [cpu.BEST.composite(replace(scene, means2d=means2d), channels)[0].ravel(), steps]
        )

    def both(steps):
        return jax.vmap(moved, (0, None))(scenes, steps)

    still, axes = jnp.zeros(count), jnp.eye(count)
    one_by_one = jnp.stack([jax.jvp(both, (still,), (axis,))[1] for axis in axes], axis=-1)
    by_view = jax.vmap(lambda scene: jax.jacfwd(lambda steps: moved(scene, steps))(still))(scenes)
    assert_allclose(by_view, one_by_one, rtol=1e-5, atol=1e-6)
    assert_allclose(jax.jacfwd(both)(still), one_by_one, rtol=1e-5, atol=1e-6)
    assert np.abs(one_by_one[:, :-count]).max() > 0.01


@pytest.mark.parametrize("threads", [0, 1, 2])
def test_a_batch_gives_the_same_bits_as_its_views_one_by_one(threads):
    scenes = [random_splats(seed, n=200) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    together = jax.vmap(lambda scene: image_and_gradient(scene, cpu.kernels(threads=threads)))(stacked)
    for i, scene in enumerate(scenes):
        for a, b in zip(together, image_and_gradient(scene), strict=True):
            assert_array_equal(a[i], b)


def test_a_smaller_scene_joins_a_batch_after_padding_with_empty_slots():
    large, small = random_gaussians(0, n=40, degree=1), random_gaussians(1, n=25, degree=1)
    camera = camera_at(size=(20, 15), focal=18.0)
    widened = jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, 15), *[(0, 0)] * (leaf.ndim - 1)]), small)
    widened = replace(widened, opacity_logits=widened.opacity_logits.at[25:].set(-jnp.inf))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), large, widened)

    def value_and_gradient(scene):
        return jax.value_and_grad(lambda g: jnp.sum(render(g, camera, backend="cpu").rgb ** 2))(scene)

    images, gradients = jax.vmap(value_and_gradient)(stacked)
    image, gradient = value_and_gradient(small)
    assert_allclose(images[1], image, rtol=1e-6)
    for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(gradient), strict=True):
        assert_allclose(a[1, :25], b, atol=1e-6)
        assert_array_equal(a[1, 25:], 0)
