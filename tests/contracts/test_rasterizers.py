"""The rules for the rasterizer of every backend. A line in `backends.BACKENDS` adds a new one."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import BLUE, GREEN, RED, at, random_splats, splats
from splatax import backends
from splatax.backends.protocol import Kernels
from splatax.rendering import composite, rasterize, select


def draw(scene, backend):
    return composite(scene, scene.colors, backend=backend)


def gradients(scene, channels, cotangents, backend):
    """Of <image, cotangents> in everything that a backend differentiates."""

    return image_and_gradients(scene, channels, cotangents, backend)[1]


@partial(jax.jit, static_argnames="backend")
def image_and_gradients(scene, channels, cotangents, backend):
    """Also the image and alpha, by the same program."""

    def objective(scene, channels):
        image, alpha = composite(scene, channels, backend=backend)
        return jnp.sum(image * cotangents[0]) + jnp.sum(alpha * cotangents[1]), (image, alpha)

    (of_scene, of_channels), drawn = jax.grad(objective, argnums=(0, 1), has_aux=True)(scene, channels)
    found = {
        "means2d": of_scene.means2d,
        "sqrt_conics": of_scene.sqrt_conics,
        "opacities": of_scene.opacities,
        "channels": of_channels,
    }
    return drawn, found if scene.pull is None else found | {"pull": of_scene.pull}


def watched(scene):
    """The scene, with the gradient of `pull` asked for."""
    return replace(scene, pull=jnp.zeros_like(scene.means2d))


def random_cotangents(scene, channels, seed=1):
    rng = np.random.default_rng(seed)
    shape = (scene.height, scene.width)
    dtype = scene.means2d.dtype
    return jnp.asarray(rng.normal(size=(*shape, channels)), dtype), jnp.asarray(rng.normal(size=shape), dtype)


def assert_same_gradients(scene, channels, backend, tolerance):
    """Against the reference."""
    cotangents = random_cotangents(scene, channels.shape[1])
    _, actual = image_and_gradients(scene, channels, cotangents, backend)
    _, expected = image_and_gradients(scene, channels, cotangents, "reference")
    assert_close_fields(actual, expected, tolerance)


def assert_same(scene, channels, backend, of_image, tolerance):
    """Also image and alpha, within another tolerance."""
    cotangents = random_cotangents(scene, channels.shape[1])
    drawn, actual = image_and_gradients(scene, channels, cotangents, backend)
    true, expected = image_and_gradients(scene, channels, cotangents, "reference")
    for found, wanted in zip(drawn, true, strict=True):
        assert_allclose(found, wanted, atol=of_image)
    assert_close_fields(actual, expected, tolerance)


def assert_close_fields(actual, expected, tolerance):
    """Errors count relative to the largest entry of a field, because they add up over pixels."""
    for name, value in expected.items():
        scale = np.abs(value).max()
        assert scale > 0
        assert_allclose(actual[name], value, atol=tolerance * scale, err_msg=name)


# --- truths that can be written down ---


def test_one_splat_has_the_alpha_of_the_formula(backend):
    scene = splats(at(2.5, 1.5, sigma=1.5, opacity=0.8), size=(5, 4))
    x, y = np.meshgrid(np.arange(5) + 0.5, np.arange(4) + 0.5)
    alpha = 0.8 * np.exp(-((x - 2.5) ** 2 + (y - 1.5) ** 2) / (2 * 1.5**2))
    alpha[alpha < 1 / 255] = 0
    image, drawn = draw(scene, backend)
    assert_allclose(drawn, alpha, atol=1e-6)
    assert_allclose(image, alpha[..., None] * RED, atol=1e-6)


def test_alpha_stops_at_99_percent(backend):
    assert_allclose(draw(splats(at(opacity=1.0)), backend)[1], 0.99, rtol=1e-6)


@pytest.mark.parametrize(("opacity", "drawn"), [(0.00391, 0.0), (0.00393, 0.00393)])
def test_alpha_below_one_8_bit_level_is_not_drawn(backend, opacity, drawn):
    scene = splats(at(opacity=opacity))
    scene = replace(scene, extents=jnp.ones_like(scene.extents))  # the rule must not rest on culling
    assert_allclose(draw(scene, backend)[1], drawn, rtol=1e-6, atol=6e-8)  # 1 - (1 - alpha) rounds


def test_sort_keys_are_the_order_and_depths_stay_what_they_are(backend):
    scene = random_splats(n=60, size=(24, 20))
    keys = jnp.asarray(np.random.default_rng(5).permutation(60) + 1.0, jnp.float32)
    keyed, resorted = replace(scene, sort_keys=keys), replace(scene, depths=keys)
    channels = jnp.concatenate([scene.colors, scene.depths[:, None]], axis=1)
    assert_array_equal(draw(keyed, backend)[0], draw(resorted, backend)[0])
    assert np.abs(draw(keyed, backend)[0] - draw(scene, backend)[0]).max() > 0.01
    cotangents = random_cotangents(scene, 4)
    found, expected = (gradients(each, channels, cotangents, backend) for each in (keyed, resorted))
    for name, value in expected.items():
        assert_array_equal(found[name], value)
    for found, expected in zip(
        select(keyed, 3, backend=backend), select(resorted, 3, backend=backend), strict=True
    ):
        assert_array_equal(found, expected)
    blended, depths = (
        rasterize(each, outputs=("depth",), features=features, backend=backend)
        for each, features in ((keyed, {}), (resorted, {"depth": scene.depths[:, None]}))
    )
    alpha = draw(keyed, backend)[1]
    assert_allclose(
        blended.depth, depths.features["depth"][..., 0] / jnp.where(alpha > 0, alpha, 1), rtol=1e-5, atol=1e-5
    )


def test_near_splat_hides_far_one_whatever_their_order_in_memory(backend):
    far_first = splats(at(depth=2, color=BLUE, opacity=0.9), at(depth=1, color=RED, opacity=0.9))
    rgb = draw(far_first, backend)[0][0, 0]
    assert_allclose(rgb, 0.9 * RED + 0.1 * 0.9 * BLUE, atol=1e-6)


def test_equal_depths_are_drawn_in_memory_order(backend):
    rows = [at(depth=1, color=color, opacity=0.5) for color in (RED, GREEN, BLUE)]
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        rgb = draw(splats(*(rows[i] for i in order)), backend)[0][0, 0]
        expected = sum(0.5 ** (k + 1) * rows[i][3] for k, i in enumerate(order))
        assert_allclose(rgb, expected, atol=1e-6)


def test_depths_that_differ_in_the_last_bit_are_ordered(backend):
    near = np.float32(3.0)
    far = np.nextafter(near, np.float32(4))
    rgb = draw(
        splats(at(depth=far, color=BLUE, opacity=0.5), at(depth=near, color=RED, opacity=0.5)), backend
    )[0]
    assert_allclose(rgb[0, 0], 0.5 * RED + 0.25 * BLUE, atol=1e-6)


def test_the_splat_that_would_take_transmittance_below_its_floor_is_not_drawn(backend):
    # Two splats of 0.98 leave 4e-4; the third would leave 8e-6, so neither it nor any behind it is
    # drawn, not even the faint last one, which alone would have left enough.
    opacities = (0.98, 0.98, 0.98, 0.1)
    colors = (RED, GREEN, BLUE, BLUE)
    rows = [at(depth=d + 1, color=colors[d], opacity=opacities[d]) for d in range(4)]
    rgb, alpha = draw(splats(*rows), backend)
    assert_allclose(rgb[0, 0], 0.98 * RED + 0.02 * 0.98 * GREEN, atol=1e-6)
    assert_allclose(alpha[0, 0], 1 - 0.02**2, atol=1e-6)


def test_nothing_visible_gives_an_empty_image(backend):
    scene = random_splats(n=20)
    image, alpha = draw(replace(scene, extents=jnp.zeros_like(scene.extents)), backend)
    assert_array_equal(image, 0)
    assert_array_equal(alpha, 0)


def test_no_splats_at_all_give_an_empty_image(backend):
    scene = jax.tree.map(lambda leaf: leaf[:0], random_splats(n=2))
    image, alpha = draw(scene, backend)
    assert image.shape == (53, 70, 3)
    assert_array_equal(alpha, 0)


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (7, 9)])
def test_images_of_any_shape(backend, size):
    scene = random_splats(n=50, size=size)
    image, alpha = draw(scene, backend)
    assert image.shape == (size[1], size[0], 3)
    assert_allclose(alpha, draw(scene, "reference")[1], atol=1e-5)


# --- symmetries ---


def test_order_in_memory_does_not_matter(backend):
    scene = random_splats()
    scene = replace(scene, depths=jnp.linspace(1, 9, len(scene.depths)))  # no ties
    shuffled = jnp.asarray(np.random.default_rng(0).permutation(len(scene.depths)))
    permuted = jax.tree.map(lambda leaf: leaf[shuffled], scene)
    assert_array_equal(draw(scene, backend)[0], draw(permuted, backend)[0])


def test_culled_rows_change_nothing_and_get_no_gradient(backend):
    scene = random_splats(n=100)
    culled = replace(scene, extents=jnp.zeros_like(scene.extents))
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), scene, culled)
    assert_array_equal(draw(scene, backend)[0], draw(both, backend)[0])
    for name, value in gradients(both, both.colors, random_cotangents(both, 3), backend).items():
        assert_array_equal(value[100:], 0, err_msg=name)


# --- the pull of pixels ---


def test_pull_is_the_sum_over_pixels_of_absolute_derivatives(backend):
    # One pixel after the other: the derivative of what it adds to the objective, by JAX through `reference`.
    scene = random_splats(7, n=12, size=(9, 6), sigma=(0.8, 3.0))
    weights, weight = random_cotangents(scene, 3)

    def at_pixels(means2d):
        image, alpha = draw(replace(scene, means2d=means2d), "reference")
        return jnp.sum(image * weights, axis=-1) + alpha * weight

    expected = np.abs(jax.jacrev(at_pixels)(scene.means2d)).sum(axis=(0, 1))
    assert np.count_nonzero(expected) > 12
    pull = gradients(watched(scene), scene.colors, (weights, weight), backend)["pull"]
    assert_allclose(pull, expected, rtol=1e-4, atol=1e-5 * expected.max())


def test_opposite_pulls_add_up_where_their_sum_is_nothing(backend):
    scene = watched(splats(at(8, 8, sigma=2.0, opacity=0.5), size=(16, 16)))  # symmetric, as is the loss
    ones = (jnp.ones((16, 16, 3)), jnp.ones((16, 16)))
    found = gradients(scene, scene.colors, ones, backend)
    # 2 alpha |dx| / sigma^2 at each pixel, where the splat is drawn: red and alpha count.
    offset = np.arange(16) + 0.5 - 8
    alpha = 0.5 * np.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / 8)
    expected = np.sum(2 * np.where(alpha >= 1 / 255, alpha, 0) * np.abs(offset) / 4)
    assert_allclose(found["means2d"], 0, atol=1e-5)
    assert_allclose(found["pull"], expected, rtol=1e-5)


def test_pull_of_culled_rows_is_nothing(backend):
    scene = random_splats(n=100)
    culled = watched(replace(scene, extents=scene.extents.at[50:].set(0)))
    pull = gradients(culled, culled.colors, random_cotangents(culled, 3), backend)["pull"]
    assert_array_equal(pull[50:], 0)
    assert pull[:50].any()


# --- against the reference ---


@pytest.mark.parametrize("seed", range(3))
def test_image_and_gradients_equal_the_reference(fast, seed):
    scene = random_splats(seed)
    assert_same(scene, scene.colors, fast, 2e-6, 2e-5)


def test_double_precision_equals_the_reference_to_its_rounding(fast, x64):
    scene = random_splats(3, dtype=np.float64)
    if reason := backends.why_unavailable(fast, np.float64):
        pytest.skip(reason)
    assert_same(scene, scene.colors, fast, 1e-13, 1e-11)


@pytest.mark.parametrize("channels", [1, 3, 4, 5, 16])
def test_pull_equals_the_reference_and_leaves_the_other_gradients(fast, channels):
    if channels > 4 and isinstance(fast, Kernels):
        pytest.skip("the CUDA kernels give the gradient of `pull` for up to 4 channels")
    scene = random_splats(6)
    values = jnp.asarray(np.random.default_rng(2).normal(size=(400, channels)).astype(np.float32))
    assert_same_gradients(watched(scene), values, fast, 2e-5)
    cotangents = random_cotangents(scene, channels)
    with_pull = gradients(watched(scene), values, cotangents, fast)
    for name, value in gradients(scene, values, cotangents, fast).items():
        assert_allclose(with_pull[name], value, atol=2e-6 * np.abs(value).max(), err_msg=name)


def test_pull_of_thousands_of_splats_in_one_tile(fast):
    scene = random_splats(n=5000, size=(16, 12), sigma=(0.5, 6), opacity=(0.004, 0.05))
    assert_same_gradients(watched(scene), scene.colors, fast, 1e-4)


def test_pull_in_double_precision_equals_the_reference_to_its_rounding(fast, x64):
    if reason := backends.why_unavailable(fast, np.float64):
        pytest.skip(reason)
    scene = random_splats(3, dtype=np.float64)
    assert_same_gradients(watched(scene), scene.colors, fast, 1e-11)


@pytest.mark.parametrize("channels", [1, 4, 5, 13, 16, 17, 70])  # around the widths that kernels take at once
def test_any_number_of_channels(fast, channels):
    scene = random_splats(n=150)
    values = jnp.asarray(np.random.default_rng(2).normal(size=(150, channels)).astype(np.float32))
    assert_same(scene, values, fast, 1e-5, 2e-5)


def test_thousands_of_splats_in_one_tile(fast):
    scene = random_splats(n=5000, size=(16, 12), sigma=(0.5, 6), opacity=(0.004, 0.05))
    assert_same(scene, scene.colors, fast, 2e-5, 1e-4)


def test_one_splat_over_the_whole_image_among_small_ones(fast):
    small = random_splats(n=200, size=(120, 90), sigma=(0.5, 3))
    large = splats(at(60, 45, sigma=300, depth=5, opacity=0.7), size=(120, 90))
    scene = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), small, large)
    assert_same(scene, scene.colors, fast, 2e-6, 2e-5)


def test_a_needle_across_the_image_keeps_its_shape(fast):
    # 0.55 by 400 pixels at 45 degrees: the form a dx^2 + 2 b dx dy + c dy^2 would lose its digits.
    root = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
    covariance = root @ np.diag([400.0**2, 0.3]) @ root.T
    rows = [((60.0, 45.0), covariance, 1.0, RED, 0.9)]
    scene = splats(*rows, size=(120, 90))
    exact = draw(splats(*rows, size=(120, 90), dtype=np.float64), "reference")[1]
    assert_allclose(draw(scene, fast)[1], exact, atol=2e-4)


# --- transformations of JAX ---


def test_vmap_over_scenes_equals_a_loop(backend):
    scenes = [random_splats(seed, n=60, size=(20, 17)) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    images = jax.vmap(lambda scene: draw(scene, backend)[0])(stacked)
    for image, scene in zip(images, scenes, strict=True):
        assert_allclose(image, draw(scene, backend)[0], atol=1e-6)


def test_the_same_call_gives_the_same_bits(backend):
    scene = random_splats(5)
    cotangents = random_cotangents(scene, 3)
    first, second = (gradients(scene, scene.colors, cotangents, backend) for _ in range(2))
    for name, value in first.items():
        assert_array_equal(value, second[name], err_msg=name)


# --- the registry ---


def test_an_unknown_backend_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"no backend 'metal': choose from auto, reference, xla, cuda, cpu"):
        backends.resolve("metal")


def test_a_backend_asked_for_by_name_never_falls_back(monkeypatch):
    broken = replace(backends.kernels("xla"), why_unavailable=lambda: "no such luck")
    monkeypatch.setattr(backends.portable, "KERNELS", broken)
    with pytest.raises(ValueError, match="'xla' is not available: no such luck"):
        backends.resolve("xla")
