"""Outputs of `render` on every backend: values, derivatives, and that only requested ones are computed."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import (
    BLUE,
    GREEN,
    RED,
    at,
    camera_at,
    plane_of_gaussians,
    random_gaussians,
    random_splats,
    splats,
)
from splatax import AlongRays, Dilation, backends, outputs
from splatax.cameras import RollingShutter
from splatax.cameras.geometry import rays
from splatax.cameras.lenses import Fisheye
from splatax.rendering import rasterize, render, select

GAUSSIANS = random_gaussians(n=80, degree=1, scale=(0.1, 0.5))
CAMERA = camera_at((0.3, 0.2, -3.0), size=(32, 24))
ALL = tuple(outputs.OUTPUTS)
OF_SURFACES = ("surface_depth", "median_surface_depth", "normals")
VIEWS = {  # other cameras than a pinhole that stands still
    "fisheye": {"lens": Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004]))},
    "rolling shutter": {"motion": RollingShutter(jnp.array([0.02, -0.03, 0.05, 0.06, 0.02, -0.04]))},
}


def opaque_pair(first, second, depths=(1.0, 2.0)):
    """Two splats of these opacities in front of each other."""
    return splats(
        at(depth=depths[0], color=RED, opacity=first), at(depth=depths[1], color=BLUE, opacity=second)
    )


# --- truths that can be written down ---


def test_depth_is_the_weighted_mean_and_the_median_depth_that_of_the_splat_that_passes_one_half(backend):
    # Weights 0.4 and 0.6 * 0.8 = 0.48; the transmittance is 0.6 after the first, and 0.12 after the second.
    drawn = rasterize(opaque_pair(0.4, 0.8), outputs=("depth", "median_depth"), backend=backend)
    assert_allclose(drawn.depth, (0.4 * 1 + 0.48 * 2) / 0.88, rtol=1e-6)
    assert_array_equal(drawn.median_depth, 2.0)
    nearer = rasterize(opaque_pair(0.6, 0.8), outputs=("median_depth",), backend=backend)
    assert_array_equal(nearer.median_depth, 1.0)


def test_a_pixel_that_is_less_than_half_covered_has_no_median_depth(backend):
    drawn = rasterize(opaque_pair(0.2, 0.2), outputs=("median_depth", "alpha"), backend=backend)
    assert 0 < drawn.alpha[0, 0] < 0.5
    assert_array_equal(drawn.median_depth, 0.0)


def test_distance_is_measured_from_the_optical_centre_to_the_gaussians(backend):
    one = jax.tree.map(lambda leaf: leaf[:1], GAUSSIANS)
    mean = jnp.array([[0.9, -0.6, 0.3]])
    one = replace(one, means=mean, log_scales=jnp.full((1, 3), np.log(0.3, dtype=np.float32)))
    one = replace(one, opacity_logits=jnp.full(1, 3.0))
    drawn = render(one, CAMERA, outputs=("distance", "depth", "alpha"), backend=backend)
    covered = np.asarray(drawn.alpha) > 0
    assert covered.any()
    assert not covered.all()
    expected = np.linalg.norm(np.asarray(mean[0]) - np.array([0.3, 0.2, -3.0]))
    assert_allclose(drawn.distance[covered], expected, rtol=1e-5)
    assert_allclose(drawn.distance[~covered], 0)
    assert (np.asarray(drawn.depth)[covered] < expected).all()  # it is off the axis


def test_surface_depths_and_normals_of_a_plane_are_exact(backend):
    normal = np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])
    drawn = render(
        plane_of_gaussians(normal, n=600, half=2.0, sigma=0.15),
        CAMERA,
        outputs=("alpha", "depth", "surface_depth", "median_surface_depth", "normals"),
        backend=backend,
    )
    directions = np.asarray(rays(CAMERA), np.float64)
    distance = -(normal @ np.asarray(CAMERA.position)) / (directions @ normal)
    depth = distance * (directions @ np.asarray(CAMERA.rotation[2]))
    covered = np.asarray(drawn.alpha) > 0.5
    assert 0.9 < covered.mean() < 1
    assert_array_equal(np.asarray(drawn.median_surface_depth) > 0, covered)
    assert_allclose(drawn.surface_depth[covered], depth[covered], rtol=2e-6)
    assert_allclose(drawn.median_surface_depth[covered], depth[covered], rtol=2e-6)
    assert_allclose(drawn.normals[covered], np.broadcast_to(normal, (covered.sum(), 3)), atol=1e-5)
    assert np.median(np.abs(drawn.depth - depth)) > 0.05  # the mean of centres is not the surface


def test_contributors_are_sorted_by_weight_and_padded(backend):
    # Weights, from near to far: 0.3, 0.7 * 0.5 = 0.35, 0.35 * 0.6 = 0.21.
    rows = [
        at(depth=3, color=BLUE, opacity=0.6),
        at(depth=1, color=RED, opacity=0.3),
        at(depth=2, color=GREEN, opacity=0.5),
    ]
    asked = {"contributors": outputs.contributors(5)}
    found = rasterize(splats(*rows), outputs=asked, backend=backend).contributors
    assert_array_equal(found.indices[0, 0], [2, 1, 0, -1, -1])
    assert_allclose(found.weights[0, 0], [0.35, 0.3, 0.21, 0, 0], rtol=1e-6)


def test_features_come_back_under_their_names_weighted_like_colour(backend):
    labels = jnp.asarray(np.random.default_rng(0).uniform(size=(80, 5)), jnp.float32)
    features = {"labels": labels, "red": jnp.ones((80, 1))}
    drawn = render(GAUSSIANS, CAMERA, features=features, backend=backend)
    assert set(drawn.features) == {"labels", "red"}
    assert drawn.features["labels"].shape == (24, 32, 5)
    assert_allclose(drawn.features["red"][..., 0], drawn.alpha, atol=1e-6)
    alone = render(GAUSSIANS, CAMERA, outputs=(), features={"labels": labels}, backend=backend)
    assert_allclose(alone.features["labels"], drawn.features["labels"], atol=1e-6)


def test_the_contributors_weights_blend_features_as_the_renderer_does(backend):
    labels = jnp.asarray(np.random.default_rng(0).uniform(size=(80, 5)), jnp.float32)
    asked = {"contributors": outputs.contributors(64)}
    drawn = render(GAUSSIANS, CAMERA, outputs=asked, features={"labels": labels}, backend=backend)
    indices, weights = drawn.contributors
    picked = jnp.where((indices >= 0)[..., None], labels[indices], 0)
    assert_allclose(jnp.sum(weights[..., None] * picked, axis=2), drawn.features["labels"], atol=2e-6)


# --- against the reference ---


@pytest.mark.parametrize("seed", range(3))
def test_every_output_equals_the_reference(fast, seed):
    gaussians = random_gaussians(seed, n=200, degree=1, scale=(0.05, 0.5))
    expected = render(gaussians, CAMERA, outputs=ALL, backend="reference")
    actual = render(gaussians, CAMERA, outputs=ALL, backend=fast)
    for name in ("rgb", "alpha"):
        assert_allclose(getattr(actual, name), getattr(expected, name), atol=2e-5)
    for name in ("depth", "distance", "surface_depth"):
        assert_allclose(getattr(actual, name), getattr(expected, name), rtol=1e-3)
    assert_allclose(actual.normals, expected.normals, atol=1e-3)
    assert_allclose(actual.contributors.weights, expected.contributors.weights, atol=2e-5)
    same = np.asarray(actual.contributors.indices == expected.contributors.indices)
    assert same.mean() > 0.995  # weights that are equal to rounding may change places
    differing = np.asarray(actual.median_depth != expected.median_depth)
    close = np.isclose(actual.median_depth, expected.median_depth, rtol=1e-5)
    assert (differing & ~close).mean() < 0.005  # transmittance of one half, to rounding
    assert np.asarray(expected.median_depth).any()


@pytest.mark.parametrize("count", [1, 3, 20])
def test_thousands_of_splats_in_one_tile_are_ranked_as_by_the_reference(fast, count):
    scene = random_splats(n=3000, size=(16, 12), sigma=(0.5, 6), opacity=(0.004, 0.05))
    actual, expected = (select(scene, count, backend=name) for name in (fast, "reference"))
    assert_allclose(actual.weights, expected.weights, atol=2e-5)
    assert (np.asarray(actual.indices) == np.asarray(expected.indices)).mean() > 0.98


def test_all_outputs_of_nothing_are_empty(backend):
    nothing = jax.tree.map(lambda leaf: leaf[:0], GAUSSIANS)
    drawn = render(nothing, CAMERA, outputs=ALL, features={"f": jnp.zeros((0, 2))}, backend=backend)
    for name in ("alpha", "depth", "distance", "median_depth", "surface_depth", "median_surface_depth"):
        assert_array_equal(getattr(drawn, name), np.zeros((24, 32)))
    assert_array_equal(drawn.normals, np.zeros((24, 32, 3)))
    assert_array_equal(drawn.contributors.indices, np.full((24, 32, 8), -1))
    assert_array_equal(drawn.contributors.weights, np.zeros((24, 32, 8)))


# --- derivatives ---


def directional(objective, point, direction, step):
    """Central difference."""
    moved = [jax.tree.map(lambda p, d, sign=sign: p + sign * step * d, point, direction) for sign in (1, -1)]
    return (objective(moved[0]) - objective(moved[1])) / (2 * step)


def test_outputs_have_the_derivatives_of_finite_differences(x64, backend):
    if reason := backends.why_unavailable(backend, np.float64):
        pytest.skip(reason)
    gaussians = random_gaussians(n=12, degree=0, scale=(0.3, 0.6), dtype=np.float64)
    camera = camera_at((0.3, 0.2, -3.0), size=(8, 6), focal=8.0, dtype=np.float64)
    labels = jnp.asarray(np.random.default_rng(0).uniform(size=(12, 2)))
    names = ("depth", "distance", "median_depth", "surface_depth", "median_surface_depth", "normals")
    weights = jnp.asarray(np.random.default_rng(1).uniform(size=(7, 6, 8)))

    @jax.jit
    def objective(point):
        gaussians, camera, labels = point
        drawn = render(gaussians, camera, outputs=names, features={"labels": labels}, backend=backend)
        pictures = [*(getattr(drawn, name) for name in names), drawn.features["labels"]]
        return sum(
            jnp.sum(channel * weight**power)
            for picture, weight in zip(pictures, weights, strict=True)
            for power, channel in enumerate(jnp.moveaxis(picture.reshape(6, 8, -1), -1, 0), start=1)
        )

    point = (gaussians, camera, labels)
    gradient = jax.jit(jax.grad(objective))(point)
    assert any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient))
    rng = np.random.default_rng(2)
    for _ in range(3):
        direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), point)
        along = sum(
            jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
        )
        # Steps this small rarely move a splat across its threshold of 1/255, where the image jumps.
        assert_allclose(along, directional(objective, point, direction, 1e-7), rtol=2e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("low_pass", [Dilation(), AlongRays()], ids=["ellipses", "along rays"])
@pytest.mark.parametrize("kind", VIEWS)
def test_surfaces_through_other_cameras_have_the_derivatives_of_finite_differences(x64, kind, low_pass):
    """In the Gaussians and in all of the camera: its pose, intrinsics, lens and motion.

    Each of these arrays moves alone, so that a large derivative hides no small one.
    """
    gaussians = random_gaussians(n=12, degree=0, scale=(0.3, 0.6), dtype=np.float64)
    pinhole = camera_at((0.3, 0.2, -3.0), size=(8, 6), focal=8.0, dtype=np.float64)
    camera = jax.tree.map(lambda leaf: leaf.astype(float), replace(pinhole, **VIEWS[kind]))
    weights = np.random.default_rng(1).uniform(0.5, 1.5, size=(3, 6, 8, 3))

    @jax.jit
    def objective(point):
        drawn = render(*point, outputs=OF_SURFACES, low_pass=low_pass, backend="reference")
        pictures = [getattr(drawn, name).reshape(6, 8, -1) for name in OF_SURFACES]
        return sum(jnp.sum(p * w[..., : p.shape[2]]) for p, w in zip(pictures, weights, strict=True))

    named, tree = jax.tree_util.tree_flatten_with_path((gaussians, camera))
    leaves = [leaf for _, leaf in named]
    gradient = jax.tree.leaves(jax.jit(jax.grad(objective))((gaussians, camera)))
    rng, resting = np.random.default_rng(2), set()
    for i, (path, leaf) in enumerate(named):
        direction, name = jnp.asarray(rng.normal(size=leaf.shape)), jax.tree_util.keystr(path)
        along = jnp.sum(gradient[i] * direction)
        # Steps this small rarely move a splat across its threshold of 1/255, where the image jumps.
        ends = [
            objective(tree.unflatten([*leaves[:i], leaf + step * direction, *leaves[i + 1 :]]))
            for step in (1e-7, -1e-7)
        ]
        assert_allclose(along, (ends[0] - ends[1]) / 2e-7, rtol=2e-4, atol=1e-5, err_msg=name)
        if abs(along) < 1e-3:
            resting.add(name)
    assert resting == {"[0].sh"}  # surfaces do not depend on colours


def test_gradients_of_outputs_equal_the_reference(fast):
    labels = jnp.asarray(np.random.default_rng(0).uniform(size=(80, 9)), jnp.float32)
    rng = np.random.default_rng(1)
    weights = {
        name: jnp.asarray(rng.normal(size=(24, 32)), jnp.float32)
        for name in ("alpha", "depth", "distance", "median_depth", "surface_depth", "median_surface_depth")
    }

    @partial(jax.jit, static_argnums=3)
    @partial(jax.grad, argnums=(0, 1, 2))
    def gradient(gaussians, camera, labels, backend):
        drawn = render(gaussians, camera, outputs=ALL, features={"labels": labels}, backend=backend)
        total = sum(jnp.sum(getattr(drawn, name) * w) for name, w in weights.items())
        total += jnp.sum(
            drawn.normals * jnp.stack([weights["depth"], weights["alpha"], weights["distance"]], axis=-1)
        )
        return total + jnp.sum(drawn.features["labels"] * weights["alpha"][..., None]) + drawn.rgb.sum()

    found, expected = (gradient(GAUSSIANS, CAMERA, labels, name) for name in (fast, "reference"))
    for actual, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(actual, wanted, atol=1e-3 * max(np.abs(wanted).max(), 1e-3))


def test_contributors_have_no_gradient(backend):
    def total(gaussians):
        return render(
            gaussians, CAMERA, outputs=("contributors",), backend=backend
        ).contributors.weights.sum()

    for leaf in jax.tree.leaves(jax.grad(total)(GAUSSIANS)):
        assert_array_equal(leaf, 0)


# --- what is not asked for ---


@pytest.mark.parametrize(
    ("asked", "channels", "selected"),
    [
        (("rgb",), 3, None),
        (("alpha",), 0, None),
        (("rgb", "alpha", "depth"), 4, None),
        (("median_depth",), None, 0),
        (("contributors", "median_depth"), None, 8),
        (("distance",), 1, None),
        (("surface_depth",), 3, None),
        (("median_surface_depth",), None, 0),
        (("normals",), 3, None),
    ],
)
def test_what_is_not_asked_for_is_not_computed(asked, channels, selected):
    portable, seen = backends.resolve("xla"), {"channels": None, "selected": None}

    def composite(splats, values):
        seen["channels"] = values.shape[1]
        return portable.composite(splats, values)

    def select(splats, count):
        seen["selected"] = count
        return portable.select(splats, count)

    counting = replace(portable, name="counting", composite=composite, select=select)
    render(GAUSSIANS, CAMERA, outputs=asked, backend=counting)
    assert seen == {"channels": channels, "selected": selected}


def test_an_output_that_was_not_requested_is_named_with_the_way_out():
    drawn = render(GAUSSIANS, CAMERA, outputs=("rgb",))
    with pytest.raises(AttributeError, match=r"outputs=\('rgb'\). Request 'depth' too"):
        _ = drawn.depth
    with pytest.raises(AttributeError, match="no 'colour'; this one has 'rgb'"):
        _ = drawn.colour


def test_an_unknown_output_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="no output 'colour': choose from rgb, alpha, depth"):
        render(GAUSSIANS, CAMERA, outputs=("colour",))
    with pytest.raises(ValueError, match=r"Give a tuple of names: \('rgb',\)"):
        render(GAUSSIANS, CAMERA, outputs="rgb")
    with pytest.raises(ValueError, match="Ask for 1 to 64"):
        outputs.contributors(65)
    with pytest.raises(ValueError, match="finds 0 to 64 splats"):
        select(random_splats(n=5), 65)


@pytest.mark.parametrize("name", ["distance", "surface_depth", "median_surface_depth", "normals"])
def test_what_splats_alone_do_not_have_is_refused_with_the_way_out(name):
    with pytest.raises(ValueError, match=f"'{name}'.*use render instead of rasterize"):
        rasterize(random_splats(n=5), outputs=(name,))


def test_an_output_of_your_own_needs_no_registration(backend):
    nearness = outputs.Output(outputs.mean, lambda seen: 1 / seen.splats.depths[:, None])
    drawn = rasterize(opaque_pair(0.4, 0.8), outputs={"nearness": nearness}, backend=backend)
    assert_allclose(drawn.nearness, (0.4 + 0.48 / 2) / 0.88, rtol=1e-6)


def test_outputs_pass_through_jit_and_vmap(backend):
    cameras = [camera_at((x, 0.2, -3.0), size=(16, 12), focal=14.0) for x in (-0.5, 0.5)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    draw = jax.jit(jax.vmap(lambda camera: render(GAUSSIANS, camera, outputs=ALL, backend=backend)))
    for i, camera in enumerate(cameras):
        single = render(GAUSSIANS, camera, outputs=ALL, backend=backend)
        together = jax.tree.map(lambda leaf, i=i: leaf[i], draw(stacked))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(single), strict=True):
            assert_allclose(a, b, atol=1e-5)
