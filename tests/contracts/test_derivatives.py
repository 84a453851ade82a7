"""Both modes of differentiation of every backend, and the transformations that JAX builds on them."""

from dataclasses import replace

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


def test_forward_mode_equals_the_reference(backend):
    direction = like(POINT)
    found, expected = (jax.jvp(image_of(name), (POINT,), (direction,))[1] for name in (backend, "reference"))
    assert_same(found, expected)


def test_forward_mode_of_splats_equals_the_reference(backend):
    found, expected = (
        jax.jvp(lambda g, c, b=name: project(g, c, backend=b), POINT, like(POINT))[1]
        for name in (backend, "reference")
    )
    shown = np.asarray(project(*POINT, backend="reference").extents[:, 0] > 0)
    assert shown.any()
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(np.asarray(a)[shown], np.asarray(b)[shown], rtol=1e-3, atol=1e-3)


def test_the_two_modes_are_transposes_of_each_other(backend):
    image, push = jax.linearize(image_of(backend), POINT)
    direction, weights = like(POINT), like(image, 1)
    _, pull = jax.vjp(image_of(backend), POINT)
    dot = lambda a, b: sum(  # noqa: E731
        float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
    assert_allclose(dot(push(direction), weights), dot(direction, pull(weights)[0]), rtol=1e-3)


def test_the_jacobian_in_a_pose_is_the_same_in_both_modes(backend):
    def image(twist):
        moved = CAMERA.cam_from_world.at[:3, 3].add(twist)
        return render(GAUSSIANS, replace(CAMERA, cam_from_world=moved), outputs=("rgb",), backend=backend).rgb

    forward, backward = (jax.jit(mode(image))(jnp.zeros(3)) for mode in (jax.jacfwd, jax.jacrev))
    assert forward.shape == (12, 16, 3, 3)
    assert_same(forward, backward, 1e-3)


def test_forward_mode_composes_with_jit_vmap_scan_and_checkpoint(backend):
    direction = like(GAUSSIANS)

    def rate(camera):
        return jax.jvp(lambda g: loss_of(backend)((g, camera)), (GAUSSIANS,), (direction,))[1]

    compiled = jax.jit(rate)
    expected = jnp.stack([compiled(camera) for camera in CAMERAS])
    assert_same(jax.jit(jax.vmap(rate))(STACKED), expected)
    assert_same(jax.lax.scan(lambda carry, camera: (carry, rate(camera)), 0.0, STACKED)[1], expected)
    checkpointed = jax.checkpoint(loss_of(backend))
    found = jax.jvp(lambda g: checkpointed((g, CAMERAS[0])), (GAUSSIANS,), (direction,))[1]
    assert_same(found, expected[0])


def test_gauss_newton_products_equal_the_reference(backend):
    direction = like(POINT)

    def product(backend):
        _, tangent = jax.jvp(image_of(backend), (POINT,), (direction,))
        return jax.vjp(image_of(backend), POINT)[1](tangent)[0]

    assert_same(jax.jit(product, static_argnums=0)(backend), product("reference"), 1e-3)


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


@pytest.mark.slow
@pytest.mark.parametrize("product", [forward_over_reverse, reverse_over_forward, reverse_over_reverse])
def test_hessian_vector_products_equal_the_reference(backend, product):
    direction = like(POINT)
    found = jax.jit(lambda point: product(loss_of(backend), point, direction))(POINT)
    assert_same(found, forward_over_reverse(loss_of("reference"), POINT, direction), 2e-3)


@pytest.mark.slow
def test_the_gradient_of_a_jvp_of_a_batch_is_that_of_its_elements(backend):
    direction = like(GAUSSIANS)

    def slope(gaussians, camera):
        return jax.jvp(lambda g: loss_of(backend)((g, camera)), (gaussians,), (direction,))[1]

    total = jax.grad(lambda g: jnp.sum(jax.vmap(slope, (None, 0))(g, STACKED)))(GAUSSIANS)
    each = [jax.grad(slope)(GAUSSIANS, camera) for camera in CAMERAS]
    assert_same(total, jax.tree.map(lambda *leaves: sum(leaves), *each), 2e-3)


def test_the_gradient_of_a_scene_that_cameras_share_is_the_sum_of_theirs(backend):
    def total(gaussians, cameras):
        return jnp.sum(jax.vmap(lambda camera: loss_of(backend)((gaussians, camera)))(cameras))

    by_scene, by_camera = jax.jit(jax.grad(total, (0, 1)))(GAUSSIANS, STACKED)
    each = [jax.grad(loss_of(backend))((GAUSSIANS, camera)) for camera in CAMERAS]
    assert_same(by_scene, jax.tree.map(lambda *leaves: sum(leaves), *(scene for scene, _ in each)))
    assert_same(by_camera, jax.tree.map(lambda *leaves: jnp.stack(leaves), *(camera for _, camera in each)))


def test_batches_of_batches_and_of_scenes(backend):
    scenes = [random_gaussians(seed, n=20, degree=1) for seed in range(2)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    value = jax.value_and_grad(lambda g, c: loss_of(backend)((g, c)))
    found = jax.vmap(jax.vmap(value, (None, 0)), (0, None))(stacked, STACKED)
    expected = [[value(scene, camera) for camera in CAMERAS] for scene in scenes]
    stack = lambda *leaves: jnp.stack(leaves)  # noqa: E731
    assert_same(found, jax.tree.map(stack, *(jax.tree.map(stack, *row) for row in expected)))


def test_the_loss_has_both_modes(backend):
    image, photo = (
        jnp.asarray(a, jnp.float32) for a in np.random.default_rng(0).uniform(size=(2, 16, 16, 3))
    )
    direction = like(image)

    def loss(image, name):
        return Photometric()(image, photo, None, backends.resolve(name).photometric)

    for mode in (
        lambda name: jax.jvp(lambda x: loss(x, name), (image,), (direction,))[1],
        lambda name: jax.jvp(jax.grad(lambda x: loss(x, name)), (image,), (direction,))[1],
    ):
        assert_same(mode(backend), mode("reference"), 1e-3)
