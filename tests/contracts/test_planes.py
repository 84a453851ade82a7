"""Planes of Gaussians: native code finds them, and differentiates them, as the formulas in float64 do."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.backends.cpu.library import Build
from splatax.backends.cpu.planes import NativeRows
from splatax.cameras.lenses import Fisheye, Pinhole
from splatax.rendering import project, render
from splatax.surfaces import planes, planes_of_rows

N = 75  # not a multiple of the sixteen rows that native code takes at once
LENSES = {"pinhole": Pinhole(), "fisheye": Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004]))}
BLURS = pytest.mark.parametrize("low_pass", [sx.Dilation(), sx.AlongRays()], ids=["ellipses", "along rays"])


@pytest.fixture(params=["cpu-avx512", "cpu-avx2", "cpu-baseline"])
def native(request):
    reason = backends.why_unavailable(request.param)
    if reason is not None:
        pytest.skip(reason)
    return NativeRows(Build(request.param.removeprefix("cpu-")))


def scene(n=N):
    """Gaussians of all shapes, some of which are exactly flat, and some of which the camera does not see."""
    gaussians = random_gaussians(n=n, degree=0, spread=1.6, scale=(0.003, 0.8))
    return replace(gaussians, log_scales=gaussians.log_scales.at[::7, 1].set(-jnp.inf))


def view(lens=Pinhole()):
    return replace(camera_at((0.4, -0.3, -2.5), size=(41, 35), focal=40.0), lens=lens)


@cache
def rows_of(low_pass, dtype=np.float32, n=N):
    """The rows of a view, as a kernel gets them; flatter Gaussians would feel the rounding."""
    gaussians, found = scene(n), []
    gaussians = replace(gaussians, log_scales=jnp.maximum(gaussians.log_scales, -4))
    splats = project(gaussians, view(), low_pass=low_pass, backend="reference")

    @jax.jit
    def rows():
        planes.__wrapped__(gaussians, view(), splats, lambda rows: found.append(rows) or planes_of_rows(rows))
        return found.pop()

    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), rows())


@partial(jax.jit, static_argnames="find")
def pushed(rows, directions, find=planes_of_rows):
    """The planes, and their tangents in a direction."""
    return jax.jvp(find, (rows,), (directions,))


@partial(jax.jit, static_argnames="find")
def pulled(rows, cotangents, find=planes_of_rows):
    """The gradient of the planes, weighted with cotangents, in the rows."""
    return jax.vjp(find, rows)[1](cotangents)[0]


def like(tree, seed):
    """Random directions about as large as the numbers; the extents stay."""
    rng = np.random.default_rng(seed)
    found = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype) * (jnp.abs(x) + 0.01), tree)
    return found._replace(extents=jnp.zeros_like(tree.extents))


def moved(rows, directions, by):
    return jax.tree.map(lambda x, d: x + by * d, rows, directions)


def smooth(rows, directions, reach=1e-3):
    """Visible rows between whose planes, a small step apart, there is no kink of a limit or of the axis."""
    here, *others = (pushed(moved(rows, directions, by), directions)[1] for by in (0, reach, -reach))
    near = [
        np.abs(a - b).max(axis=1) <= 0.1 * np.abs(b).max(axis=1) + 1e-9
        for other in others
        for a, b in zip(other, here, strict=True)
    ]
    return np.all([*near, (rows.extents > 0).all(axis=1)], axis=0)


def relative(found, expected, rows):
    """Two arrays over the size of each row, for rows of a mask."""
    wide = np.asarray(expected, np.float64).reshape(len(rows), -1)
    size = np.abs(wide).max(axis=1, keepdims=True) + 1e-3 * np.median(np.abs(wide).max(axis=1)) + 1e-12
    return (np.asarray(found).reshape(len(rows), -1) / size)[rows], (wide / size)[rows]


@BLURS
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_native_planes_are_those_of_the_formulas(native, lens, low_pass):
    gaussians, camera = scene(), view(lens)
    splats = project(gaussians, camera, low_pass=low_pass, backend="reference")
    found, expected = (planes(gaussians, camera, splats, find) for find in (native, None))
    shown = np.asarray((splats.extents > 0).all(axis=1))
    assert 20 < shown.sum() < N
    for name, a, b in zip(expected._fields, found, expected, strict=True):
        assert np.isfinite(a).all(), name
        assert_allclose(*relative(a, b, shown), atol=2e-4, err_msg=name)


@pytest.mark.slow
@BLURS
def test_the_formulas_have_the_derivatives_of_finite_differences(x64, low_pass):
    rows = rows_of(low_pass, np.float64)
    directions, step = like(rows, 1), 1e-7
    kept = smooth(rows, directions)
    assert kept.sum() > 20
    tangents = pushed(rows, directions)[1]
    ahead, back = (pushed(moved(rows, directions, by), directions)[0] for by in (step, -step))
    for tangent, a, b in zip(tangents, ahead, back, strict=True):
        assert_allclose(*relative(tangent, (a - b) / (2 * step), kept), atol=1e-4)


@BLURS
def test_native_tangents_and_gradients_are_those_of_the_formulas_in_float64(native, x64, low_pass):
    rows = rows_of(low_pass)
    directions = like(rows, 1)
    found, tangents = pushed(rows, directions, native)
    rng = np.random.default_rng(2)
    cotangents = tuple(jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype) for leaf in found)
    gradients = pulled(rows, cotangents, native)
    wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (rows, directions, cotangents))
    kept = smooth(*wide[:2])
    assert kept.sum() > 20
    expected = pushed(*wide[:2])[1]
    for a, b in zip(tangents, expected, strict=True):
        assert_allclose(*relative(a, b, kept), atol=1e-3)
    true = pulled(wide[0], wide[2])
    for name, a, b in zip(true._fields[:-1], gradients, true, strict=False):
        if b.size:
            assert_allclose(*relative(a, b, kept), atol=2e-3, err_msg=name)


def test_culled_rows_have_finite_planes_and_no_gradient(native):
    rows = rows_of(sx.Dilation())
    culled = np.asarray(~(rows.extents > 0).all(axis=1))
    assert culled.any()
    spoiled = jnp.where(culled[:, None], jnp.nan, rows.quats)
    rows = rows._replace(quats=spoiled, sqrt_conics=jnp.where(culled[:, None], 0, rows.sqrt_conics))
    found, pull = jax.vjp(native, rows)
    assert all(np.isfinite(leaf).all() for leaf in found)
    (gradients,) = pull(jax.tree.map(jnp.ones_like, found))
    for name, gradient in zip(rows._fields, gradients, strict=True):
        if gradient.size:
            assert_array_equal(gradient[culled], 0, err_msg=name)
        assert np.isfinite(gradient).all(), name


def test_a_row_has_the_same_bits_alone_in_a_batch_and_on_one_thread(native):
    rows = rows_of(sx.Dilation(), n=9000)  # more than one thread takes at a time

    def both(rows, kernel=native):
        found, pull = jax.vjp(kernel, rows)
        return found, pull(jax.tree.map(jnp.ones_like, found))[0]

    whole = jax.tree.leaves(both(rows))
    alone = both(rows, NativeRows(replace(native.build, threads=1)))
    for a, b in zip(whole, jax.tree.leaves(alone), strict=True):
        assert_array_equal(a, b)
    few = both(jax.tree.map(lambda leaf: leaf[4093:4100], rows))
    for a, b in zip(whole, jax.tree.leaves(few), strict=True):
        assert_array_equal(a[4093:4100], b)
    shared = rows._replace(quats=None)
    quats = jnp.stack([rows.quats, rows.quats[::-1]])
    together = jax.vmap(lambda quats: both(shared._replace(quats=quats)))(quats)
    for a, b in zip(whole, jax.tree.leaves(together), strict=True):
        assert_array_equal(a, b[0])


@pytest.mark.slow
def test_second_derivatives_are_those_of_the_formulas(native):
    rows = rows_of(sx.Dilation())
    directions = like(rows, 3)
    kept = smooth(rows, directions)

    def energy(rows, kernel):
        slopes, normals, axes = kernel(rows)
        scored = jnp.where(kept[:, None], jnp.concatenate([slopes**2, normals**3, axes**3], axis=1), 0)
        return jnp.sum(scored)

    def hessian_product(rows, kernel):
        return jax.jvp(lambda rows: jax.grad(energy)(rows, kernel), (rows,), (directions,))[1]

    def other_way(rows, kernel):  # reverse over forward
        return jax.grad(lambda r: jax.jvp(lambda x: energy(x, kernel), (r,), (directions,))[1])(rows)

    for product in (jax.jit(way, static_argnums=1) for way in (hessian_product, other_way)):
        for name, a, b in zip(
            rows._fields, product(rows, native), product(rows, planes_of_rows), strict=True
        ):
            if a.size:
                assert_allclose(*relative(a, b, kept), atol=2e-2, err_msg=name)


def test_a_backend_with_other_planes_is_asked_for_them():
    kernels = backends.resolve("auto")
    tilted = replace(
        kernels, name="mine", planes=lambda *view: kernels.planes(*view)._replace(axes=jnp.ones((N, 3)))
    )
    normals = render(scene(), view(), outputs=("normals", "alpha"), backend=tilted)
    covered = np.asarray(normals.alpha) > 0.1
    assert covered.any()
    assert_allclose(normals.normals[covered], 3**-0.5, atol=1e-5)
