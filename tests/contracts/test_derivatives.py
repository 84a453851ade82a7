"""Both modes of differentiation of every backend, and the transformations that JAX builds on them."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import camera_at, random_gaussians, random_splats
from splatax import backends
from splatax.losses import Photometric
from splatax.rendering import composite, project, render

GAUSSIANS = random_gaussians(n=30, degree=1)
CAMERA = camera_at((0.1, 0.3, -4), size=(16, 12), focal=14.0)
CAMERAS = [camera_at((x, 0.3, -4), size=(16, 12), focal=14.0) for x in (-0.5, 0.5)]
STACKED = jax.tree.map(lambda *leaves: jnp.stack(leaves), *CAMERAS)
POINT = (GAUSSIANS, CAMERA)


def like(tree, seed=0):
    """Random directions of the shapes of a tree."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), tree)


def assert_same(actual, expected, tolerance=2e-4):
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert_allclose(a, b, atol=tolerance * max(np.abs(b).max(), 1e-3))


def image_of(backend):
    return lambda point: render(*point, outputs=("rgb", "depth"), backend=backend).images


def loss_of(backend):
    return lambda point: jnp.mean(jnp.square(render(*point, outputs=("rgb",), backend=backend).rgb))


@pytest.mark.parametrize("channels", [3, 7])
def test_forward_mode_of_the_rasterizer_equals_finite_differences(x64, backend, channels):
    if reason := backends.why_unavailable(backend, np.float64):
        pytest.skip(reason)
    scene = random_splats(n=20, size=(20, 13), dtype=np.float64)
    values = jnp.asarray(np.random.default_rng(0).normal(size=(20, channels)))
    moved = {name: like(getattr(scene, name), 1) for name in ("means2d", "sqrt_conics", "opacities")}
    moved["sqrt_conics"], moved["opacities"] = moved["sqrt_conics"] * 0.01, moved["opacities"] * 0.01
    d_values = like(values, 2)

    def draw(step):
        fields = {name: getattr(scene, name) + step * direction for name, direction in moved.items()}
        return composite(replace(scene, **fields), values + step * d_values, backend=backend)

    _, found = jax.jvp(draw, (0.0,), (1.0,))
    for tangent, ahead, back in zip(found, draw(1e-6), draw(-1e-6), strict=True):
        difference = np.asarray(ahead - back) / 2e-6
        smooth = np.abs(difference) < 1e3  # elsewhere a splat crosses its threshold of 1/255
        assert smooth.mean() > 0.99
        assert_allclose(np.asarray(tangent)[smooth], difference[smooth], rtol=1e-4, atol=1e-6)


@cache
def pushed(backend):
    """The tangent of the image in the direction of `like(POINT)`."""
    return jax.jit(lambda direction: jax.jvp(image_of(backend), (POINT,), (direction,))[1])(like(POINT))


def test_forward_mode_equals_the_reference(fast):
    assert_same(pushed(fast), pushed("reference"))


@cache
def pushed_splats(backend):
    draw = partial(project, backend=backend)
    return jax.jit(lambda direction: jax.jvp(draw, POINT, direction)[1])(like(POINT))


def test_forward_mode_of_splats_equals_the_reference(fast):
    found, expected = pushed_splats(fast), pushed_splats("reference")
    shown = np.asarray(project(*POINT, backend="reference").extents[:, 0] > 0)
    assert shown.any()
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(np.asarray(a)[shown], np.asarray(b)[shown], rtol=1e-3, atol=1e-3)


def test_the_two_modes_are_transposes_of_each_other(backend):
    direction, weights = like(POINT), like(pushed(backend), 1)
    pulled = jax.jit(lambda weights: jax.vjp(image_of(backend), POINT)[1](weights))(weights)
    dot = lambda a, b: sum(  # noqa: E731
        float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
    assert_allclose(dot(pushed(backend), weights), dot(direction, pulled[0]), rtol=1e-3)


@pytest.mark.slow
def test_the_jacobian_in_a_pose_is_the_same_in_both_modes(backend):
    camera = camera_at((0.1, 0.3, -4), size=(8, 6), focal=7.0)  # each of its numbers is a row of reverse mode

    def image(twist):
        moved = camera.cam_from_world.at[:3, 3].add(twist)
        return render(GAUSSIANS, replace(camera, cam_from_world=moved), outputs=("rgb",), backend=backend).rgb

    forward, backward = (jax.jit(mode(image))(jnp.zeros(3)) for mode in (jax.jacfwd, jax.jacrev))
    assert forward.shape == (6, 8, 3, 3)
    assert np.abs(forward).max() > 0.01
    assert_same(forward, backward, 1e-3)


@pytest.mark.slow
def test_forward_mode_composes_with_jit_vmap_scan_and_checkpoint(backend):
    """All at once: a program for each would say no more."""
    direction = like(GAUSSIANS)

    def rate(loss, camera):
        return jax.jvp(lambda g: loss((g, camera)), (GAUSSIANS,), (direction,))[1]

    alone = jax.jit(partial(rate, loss_of(backend)))
    expected = jnp.stack([alone(camera) for camera in CAMERAS])
    both = jax.vmap(partial(rate, jax.checkpoint(loss_of(backend))))
    twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), STACKED)
    _, found = jax.jit(lambda cameras: jax.lax.scan(lambda _, pair: (0.0, both(pair)), 0.0, cameras))(twice)
    assert_same(found, jnp.stack([expected, expected[::-1]]))


@cache
def gauss_newton_product(backend):
    def product(direction):
        _, tangent = jax.jvp(image_of(backend), (POINT,), (direction,))
        return jax.vjp(image_of(backend), POINT)[1](tangent)[0]

    return jax.jit(product)(like(POINT))


@pytest.mark.slow
def test_gauss_newton_products_equal_the_reference(fast):
    assert_same(gauss_newton_product(fast), gauss_newton_product("reference"), 1e-3)


def forward_over_reverse(loss, point, direction):
    """Product of the Hessian with a direction."""
    return jax.jvp(jax.grad(loss), (point,), (direction,))[1]


def reverse_over_forward(loss, point, direction):
    """The same product: the gradient of the slope along a direction."""
    return jax.grad(lambda point: jax.jvp(loss, (point,), (direction,))[1])(point)


def reverse_over_reverse(loss, point, direction):
    """The same product: the gradient of the gradient's part along a direction."""

    def along(point):
        leaves = zip(jax.tree.leaves(jax.grad(loss)(point)), jax.tree.leaves(direction), strict=True)
        return sum(jnp.sum(a * b) for a, b in leaves)

    return jax.grad(along)(point)


@cache
def hessian_vector_product(backend, product):
    return jax.jit(partial(product, loss_of(backend)))(POINT, like(POINT))


@pytest.mark.slow
@pytest.mark.parametrize("product", [forward_over_reverse, reverse_over_forward, reverse_over_reverse])
def test_hessian_vector_products_equal_the_reference(fast, product):
    expected = hessian_vector_product("reference", forward_over_reverse)
    assert_same(hessian_vector_product(fast, product), expected, 2e-3)


@pytest.mark.slow
def test_the_gradient_of_a_jvp_of_a_batch_is_that_of_its_elements(backend):
    direction = like(GAUSSIANS)

    def slope(gaussians, camera):
        return jax.jvp(lambda g: loss_of(backend)((g, camera)), (gaussians,), (direction,))[1]

    total = jax.jit(jax.grad(lambda g: jnp.sum(jax.vmap(slope, (None, 0))(g, STACKED))))(GAUSSIANS)
    gradient = jax.jit(jax.grad(slope))
    each = [gradient(GAUSSIANS, camera) for camera in CAMERAS]
    assert_same(total, jax.tree.map(lambda *leaves: sum(leaves), *each), 2e-3)


@pytest.mark.slow
def test_the_gradient_of_a_scene_that_cameras_share_is_the_sum_of_theirs(backend):
    def total(gaussians, cameras):
        return jnp.sum(jax.vmap(lambda camera: loss_of(backend)((gaussians, camera)))(cameras))

    by_scene, by_camera = jax.jit(jax.grad(total, (0, 1)))(GAUSSIANS, STACKED)
    gradient = jax.jit(jax.grad(loss_of(backend)))
    each = [gradient((GAUSSIANS, camera)) for camera in CAMERAS]
    assert_same(by_scene, jax.tree.map(lambda *leaves: sum(leaves), *(scene for scene, _ in each)))
    assert_same(by_camera, jax.tree.map(lambda *leaves: jnp.stack(leaves), *(camera for _, camera in each)))


@pytest.mark.slow
def test_batches_of_batches_and_of_scenes(backend):
    scenes = [random_gaussians(seed, n=20, degree=1) for seed in range(2)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    value = jax.value_and_grad(lambda g, c: loss_of(backend)((g, c)))
    found = jax.jit(jax.vmap(jax.vmap(value, (None, 0)), (0, None)))(stacked, STACKED)
    alone = jax.jit(value)
    expected = [[alone(scene, camera) for camera in CAMERAS] for scene in scenes]
    stack = lambda *leaves: jnp.stack(leaves)  # noqa: E731
    assert_same(found, jax.tree.map(stack, *(jax.tree.map(stack, *row) for row in expected)))


@cache
def rates_of_the_loss(backend):
    """Of the loss of a picture, and of its gradient, in a direction."""
    image, photo = (
        jnp.asarray(a, jnp.float32) for a in np.random.default_rng(0).uniform(size=(2, 16, 16, 3))
    )

    def loss(image):
        return Photometric()(image, photo, None, backends.resolve(backend).photometric)

    return jax.jit(lambda direction: [jax.jvp(f, (image,), (direction,))[1] for f in (loss, jax.grad(loss))])(
        like(image)
    )


def test_the_loss_has_both_modes(fast):
    assert_same(rates_of_the_loss(fast), rates_of_the_loss("reference"), 1e-3)
