"""Projections by native kernels do what `splatax.projection` defines, in both modes, through every lens."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.backends.cpu.projection import LENSES as NATIVE
from splatax.cameras import lenses
from splatax.low_pass import Antialiasing, Dilation
from splatax.rendering import project

LENSES = {  # with all of their coefficients; both that distort fold inside of the image or behind the camera
    "pinhole": lenses.Pinhole(),
    "opencv": lenses.opencv(-0.3, 0.02, 0.004, -0.003, 0.01, 0.02, -0.01, 0.005, 0.002, 0.001, -0.003, 0.002),
    "fisheye": lenses.Fisheye(jnp.array([-0.1, 0.004, -0.002, 0.0003])),
}
BUILDS = ("cpu-avx512", "cpu-avx2", "cpu-baseline")
GAUSSIANS = random_gaussians(n=300, degree=2, spread=2.5)  # some behind the camera, some beside the image


def test_every_lens_with_a_kernel_is_held_to_this_contract():
    assert {type(lens) for lens in LENSES.values()} == set(NATIVE)


@pytest.fixture(params=BUILDS)
def build(request):
    if reason := backends.why_unavailable(request.param):
        pytest.skip(reason)
    return request.param


@pytest.fixture(params=LENSES)
def lens(request):
    return request.param


def point_of(lens):
    return GAUSSIANS, replace(camera_at((0.3, 0.2, -3.0), size=(64, 48), focal=30.0), lens=LENSES[lens])


def drawn_of(low_pass, backend):
    """The differentiable fields, with zeros where culled, and the extents."""

    def drawn(gaussians, camera):
        splats = project(gaussians, camera, low_pass=low_pass, backend=backend)
        seen = splats.extents[:, :1] > 0
        fields = splats.means2d, splats.sqrt_conics, splats.depths, splats.colors, splats.opacities
        return [
            jnp.where(seen if field.ndim == 2 else seen[:, 0], field, 0) for field in fields
        ], splats.extents

    return drawn


def random_like(tree, seed):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), tree)


@cache
def derivatives(lens, low_pass, backend):
    """Splats, their gradient with random weights, and their tangents in a random direction."""
    drawn, point = drawn_of(low_pass, backend), point_of(lens)

    @jax.jit
    def found(point, direction):
        fields, pull, extents = jax.vjp(drawn, *point, has_aux=True)
        tangents, _ = jax.jvp(drawn, point, direction, has_aux=True)[1:]
        return fields, pull(random_like(fields, 1)), tangents, extents

    return found(point, random_like(point, 2))


def assert_close(actual, expected, tolerance):
    for (path, a), b in zip(jax.tree.leaves_with_path(actual), jax.tree.leaves(expected), strict=True):
        largest = np.abs(b).max(initial=0.0)
        assert_allclose(a, b, atol=tolerance * largest, err_msg=jax.tree_util.keystr(path))


def test_splats_gradients_and_tangents_equal_those_of_plain_jax(build, lens):
    assert_equals_plain_jax(build, lens, Antialiasing())


@pytest.mark.slow
def test_another_low_pass_equals_that_of_plain_jax(build):
    """Through one lens: the filter is applied after it."""
    assert_equals_plain_jax(build, "opencv", Dilation())


def assert_equals_plain_jax(build, lens, low_pass):
    *expected, extents = derivatives(lens, low_pass, "xla")
    *actual, own_extents = derivatives(lens, low_pass, build)
    seen = np.asarray(extents[:, 0] > 0)
    assert 30 < seen.sum() < 295
    assert_array_equal(own_extents[:, 0] > 0, seen)
    for a, b, tolerance in zip(actual, expected, (3e-6, 2e-4, 2e-4), strict=True):
        assert_close(a, b, tolerance)


def test_tangents_and_gradients_are_transposes_of_each_other(build, lens):
    drawn, point = drawn_of(Antialiasing(), build), point_of(lens)
    direction = random_like(point, 3)
    fields, push = jax.linearize(lambda point: drawn(*point)[0], point)
    weights = random_like(fields, 4)
    _, pull = jax.vjp(lambda point: drawn(*point)[0], point)

    def dot(a, b):
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        return sum(float(np.vdot(np.float64(x), np.float64(y))) for x, y in pairs)

    forward, backward = dot(push(direction), weights), dot(direction, pull(weights)[0])
    assert abs(forward - backward) < 2e-4 * dot(
        jax.tree.map(jnp.abs, push(direction)), jax.tree.map(jnp.abs, weights)
    )


@pytest.mark.slow
def test_tangents_equal_finite_differences(x64, lens):
    if reason := backends.why_unavailable("cpu"):
        pytest.skip(reason)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), point_of(lens))
    direction = jax.tree.map(lambda leaf: leaf * 0.1, random_like(single, 5))
    tangents = jax.jvp(lambda *point: drawn_of(Dilation(), "cpu")(*point)[0], single, direction)[1]

    @jax.jit
    def moved(step):
        point = jax.tree.map(
            lambda leaf, along: leaf.astype(np.float64) + step * along.astype(np.float64), single, direction
        )
        return drawn_of(Dilation(), "xla")(*point)[0]

    # Beside the image the Jacobian is taken at a place that is found in a table, which has no derivative.
    means2d = np.asarray(moved(0.0)[0])
    inside = ((means2d > 0) & (means2d < (64, 48))).all(axis=1)
    assert inside.sum() > 30
    for tangent, ahead, back in zip(tangents, moved(1e-6), moved(-1e-6), strict=True):
        difference = np.asarray(ahead - back)[inside] / 2e-6
        assert_allclose(np.asarray(tangent)[inside], difference, atol=1e-3 * np.abs(difference).max())


def test_directions_of_one_view_in_one_call_give_what_each_gives(build, lens):
    gaussians, camera = point_of(lens)
    along = jax.vmap(lambda seed: jax.tree.map(lambda leaf: leaf * seed, camera))(jnp.array([0.5, -1.0, 2.0]))

    def rates(direction):
        drawn = lambda camera: drawn_of(Dilation(), build)(gaussians, camera)[0]  # noqa: E731
        return jax.jvp(drawn, (camera,), (direction,))[1]

    together = jax.jit(jax.vmap(rates))(along)
    for k in range(3):
        one = jax.jit(rates)(jax.tree.map(lambda leaf, k=k: leaf[k], along))
        assert_close([tangents[k] for tangents in together], one, 1e-6)


@pytest.mark.slow
def test_inputs_that_stay_have_no_part_in_the_tangents(build):
    gaussians, camera = point_of("opencv")
    still = jax.tree.map(jnp.zeros_like, (gaussians, camera))
    drawn = jax.jit(lambda *point: drawn_of(Antialiasing(), build)(*point)[0])
    for part in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        value = getattr(gaussians, part)
        direction = random_like(value, 6)
        moved = lambda x, part=part: drawn(replace(gaussians, **{part: x}), camera)  # noqa: E731
        alone = jax.jvp(moved, (value,), (direction,))[1]
        moving = (replace(still[0], **{part: direction}), still[1])
        assert_close(alone, jax.jvp(drawn, (gaussians, camera), moving)[1], 1e-6)
