"""Nothing malformed reaches a kernel: wrong shapes and dtypes are refused in words, in Python and in C++.

Hypothesis makes the wrong arrays. A crash of the process is a failed test; `make sanitize` runs the native
half under the address and undefined-behaviour sanitizers.
"""

import re
import warnings
from dataclasses import fields, replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from scenes import camera_at, random_gaussians, random_splats
from splatax import backends
from splatax.backends import cpu
from splatax.cameras import Camera, lenses
from splatax.dataset import Dataset, PointCloud, View
from splatax.errors import DatasetError
from splatax.evaluation import evaluate
from splatax.losses import Photometric
from splatax.low_pass import Antialiasing, Dilation
from splatax.moving import Moments, Rule, Step
from splatax.rendering import Renderer, composite, project, rasterize, render, select
from splatax.training import recipes
from splatax.training.loop import fit
from splatax.training.optimizer import LearningRates

N, SIZE = 12, (10, 7)
CAMERA = camera_at(size=SIZE, focal=8.0)
GAUSSIANS = random_gaussians(n=N, degree=1)
SPLATS = random_splats(n=N, size=SIZE)
STEP = Step(
    rates=LearningRates().at(jnp.float32(0), jnp.ones(N), 4),
    free=jnp.ones(4, bool),
    good=jnp.asarray(True),
    steps=jnp.int32(1),
    living=jnp.int32(N),
    extent=jnp.float32(1),
    keys=jnp.ones((1, 2), jnp.uint32),
)
EXAMPLES = settings(
    max_examples=100,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
WRONG_DTYPES = (np.int32, np.float16, np.bool_, np.uint8)


# The oracle's way from the door to its kernels is that of the portable backend: `fast` has each way.


@pytest.fixture(autouse=True)
def installed(as_users_have_it):
    pass


@st.composite
def wrong_shapes(draw, shape):
    """A shape that is none of those that would fit: an axis more, less, longer, shorter, empty or moved."""
    wrong = list(shape)
    how = draw(st.sampled_from(["size", "insert", "drop", "move"]))
    if how == "size" and wrong:
        axis = draw(st.integers(0, len(wrong) - 1))
        wrong[axis] = draw(st.integers(0, 2 * wrong[axis] + 3).filter(lambda n: n != shape[axis]))
    elif how == "drop" and wrong:
        wrong.pop(draw(st.integers(0, len(wrong) - 1)))
    elif how == "move" and len(set(wrong)) > 1:
        wrong = draw(st.permutations(wrong).filter(lambda order: list(order) != list(shape)))
    else:
        wrong.insert(draw(st.integers(0, len(wrong))), draw(st.integers(0, 4)))
    return tuple(wrong)


@st.composite
def spoiled(draw, record, names):
    """A record with one field of a wrong shape or dtype."""
    name = draw(st.sampled_from(names))
    right = np.asarray(getattr(record, name))
    if draw(st.integers(0, 3)) == 0:
        return replace(record, **{name: jnp.asarray(right.astype(draw(st.sampled_from(WRONG_DTYPES))))})
    shape = draw(wrong_shapes(right.shape))
    return replace(record, **{name: jnp.ones(shape, right.dtype)})


def arrays_of(record):
    return [field.name for field in fields(record) if isinstance(getattr(record, field.name), jax.Array)]


def assert_refused(call):
    """The call raises one line of words that begins with what is malformed and ends with a full stop."""
    with pytest.raises(ValueError, match=r"has|is|every|coefficients") as refusal:
        jax.block_until_ready(call())
    assert re.fullmatch(r"(Gaussians|Camera|Splats|\d+ SH coefficients)[^\n]*[.)]", str(refusal.value))


@EXAMPLES
@given(gaussians=spoiled(GAUSSIANS, arrays_of(GAUSSIANS)))
def test_a_malformed_scene_is_refused_forward_and_backward(fast, gaussians):
    # SH of 1, 4, 9 ... coefficients are all right, and so is a scene of which nothing but its size changed.
    if gaussians.sh.shape[0] == N and gaussians.sh.shape[1:] in {(k * k, 3) for k in range(1, 6)}:
        return
    assert_refused(lambda: render(gaussians, CAMERA, backend=fast))
    by_scene = jax.grad(lambda scene: render(scene, CAMERA, backend=fast).rgb.sum(), allow_int=True)
    assert_refused(lambda: by_scene(gaussians))
    by_camera = jax.grad(lambda camera: render(gaussians, camera, backend=fast).rgb.sum())
    assert_refused(lambda: by_camera(CAMERA))


@EXAMPLES
@given(camera=spoiled(CAMERA, arrays_of(CAMERA)))
def test_a_malformed_camera_is_refused_forward_and_backward(fast, camera):
    assert_refused(lambda: render(GAUSSIANS, camera, backend=fast))
    assert_refused(lambda: jax.grad(lambda g: render(g, camera, backend=fast).rgb.sum())(GAUSSIANS))


@EXAMPLES
@given(splats=spoiled(SPLATS, arrays_of(SPLATS)))
def test_malformed_splats_are_refused_forward_and_backward(fast, splats):
    assert_refused(lambda: rasterize(splats, backend=fast))
    by_channels = jax.grad(lambda channels: composite(splats, channels, backend=fast)[0].sum())
    assert_refused(lambda: by_channels(SPLATS.colors))


@EXAMPLES
@given(shape=wrong_shapes((N, 3)))
def test_channels_and_features_need_a_row_for_each_splat(fast, shape):
    if len(shape) == 2 and shape[0] == N:
        return  # any number of channels
    values = jnp.ones(shape)
    assert_refused(lambda: composite(SPLATS, values, backend=fast))
    assert_refused(lambda: rasterize(SPLATS, features={"labels": values}, backend=fast))


def test_stacked_cameras_are_refused_with_the_way_out(backend):
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), CAMERA)
    with pytest.raises(ValueError, match=r"use jax\.vmap for a batch"):
        render(GAUSSIANS, two, backend=backend)
    images = jax.vmap(lambda camera: render(GAUSSIANS, camera, backend=backend).rgb)(two)
    assert_allclose(images[1], render(GAUSSIANS, CAMERA, backend=backend).rgb, atol=1e-6)


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (-1, 5), (2.0, 5), (5, True), (5, 10**7)])
def test_an_image_without_a_size_is_refused(backend, size):
    with pytest.raises(ValueError, match="whole number of pixels"):
        render(GAUSSIANS, replace(CAMERA, width=size[0], height=size[1]), backend=backend)


def test_an_empty_scene_is_the_background(backend):
    nothing = jax.tree.map(lambda leaf: leaf[:0], GAUSSIANS)
    image = render(nothing, CAMERA, background=jnp.array([0.1, 0.2, 0.3]), backend=backend)
    assert_array_equal(image.rgb, jnp.broadcast_to(jnp.array([0.1, 0.2, 0.3]), (*SIZE[::-1], 3)))
    gradient = jax.grad(lambda g: render(g, CAMERA, backend=backend).rgb.sum())(nothing)
    assert gradient.means.shape == (0, 3)


def test_mixed_dtypes_are_refused(x64):
    mixed = replace(GAUSSIANS, quats=GAUSSIANS.quats.astype(np.float64))
    with pytest.raises(ValueError, match="quats is float64, but means is float32"):
        render(mixed, CAMERA)
    double = jax.tree.map(lambda leaf: leaf.astype(np.float64), GAUSSIANS)
    with pytest.raises(ValueError, match="cam_from_world is float32, but means is float64"):
        render(double, CAMERA)


def test_lists_instead_of_arrays_are_refused():
    with pytest.raises(ValueError, match=r"quats is list, not an array. Convert it: jnp.asarray\(quats\)"):
        render(replace(GAUSSIANS, quats=GAUSSIANS.quats.tolist()), CAMERA)


VIEW = View("a.png", CAMERA, lambda: np.zeros((*SIZE[::-1], 3), np.uint8))
CAPTURE = Dataset((VIEW,), (), PointCloud(np.zeros((0, 3)), np.zeros((0, 3))))


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: render(CAMERA, GAUSSIANS), "the scene is of the type Camera. Give Gaussians"),
        (lambda: render(GAUSSIANS, VIEW), "the camera is of the type View. Give one Camera"),
        (lambda: project(GAUSSIANS, [CAMERA]), "the camera is of the type list. Give one Camera"),
        (
            lambda: render(GAUSSIANS, CAMERA, low_pass="antialiasing"),
            "low_pass is the text 'antialiasing'. Give",
        ),
        (lambda: project(GAUSSIANS, CAMERA, low_pass="dilation"), "low_pass is the text 'dilation'. Give"),
        (lambda: render(GAUSSIANS, CAMERA, projection="ewa"), "projection is the text 'ewa'. Give Ewa"),
        (lambda: evaluate(GAUSSIANS, VIEW), "views is of the type View. Give several"),
        (
            lambda: evaluate(GAUSSIANS, CAPTURE),
            "views is of the type Dataset. Give several, such as dataset.test",
        ),
        (lambda: fit(CAPTURE.train, recipes.default()), "dataset is of the type tuple. Give one"),
        (lambda: fit(CAPTURE, "default"), "recipe is the text 'default'. Give one, such as"),
    ],
)
def test_an_argument_of_another_kind_is_named_with_the_way_out(call, told):
    with pytest.raises(TypeError, match=re.escape(told)):
        call()


def test_a_colour_by_name_no_views_and_half_a_step_are_refused():
    with pytest.raises(ValueError, match=r"background is the text 'white'. Give RGB, such as splatax.WHITE"):
        render(GAUSSIANS, CAMERA, background="white")
    with pytest.raises(DatasetError, match="no views to score"):
        evaluate(GAUSSIANS, [])
    for wrong in (0, -5, 10.5):
        with pytest.raises(ValueError, match=f"steps of a recipe must be a whole .* not {wrong}"):
            fit(CAPTURE, recipes.default(steps=wrong))


# --- what is allowed ---


def test_a_camera_from_a_double_precision_pose_has_the_dtype_that_jax_computes_in():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera = Camera.simple_pinhole(8.0, np.asarray(CAMERA.cam_from_world, np.float64), *SIZE)
    assert camera.fx.dtype == np.float32
    assert render(GAUSSIANS, camera).rgb.shape == (*SIZE[::-1], 3)


def test_a_data_set_and_its_views_are_shown_in_a_line():
    assert repr(CAPTURE) == "Dataset(1 training views, 0 held-out views, 0 points)"
    assert "function" not in repr(VIEW)


def test_a_background_is_one_colour_or_one_for_each_pixel(backend):
    picture = jnp.asarray(np.random.default_rng(0).uniform(size=(*SIZE[::-1], 3)), jnp.float32)
    image = render(GAUSSIANS, CAMERA, background=picture, backend=backend)
    black = render(GAUSSIANS, CAMERA, backend=backend)
    assert_allclose(image.rgb, black.rgb + (1 - black.alpha)[..., None] * picture, atol=1e-6)
    gradient = jax.grad(lambda b: render(GAUSSIANS, CAMERA, background=b, backend=backend).rgb.sum())(picture)
    assert_allclose(gradient, jnp.broadcast_to((1 - black.alpha)[..., None], picture.shape), atol=1e-6)
    for wrong in [(1,), (4,), (3, 1), SIZE[::-1], (*SIZE, 3), (1, *SIZE[::-1], 3)]:
        with pytest.raises(ValueError, match=r"background has shape .*Give one colour"):
            render(GAUSSIANS, CAMERA, background=jnp.ones(wrong), backend=backend)


def test_arrays_of_numpy_are_rendered_by_the_backend_of_the_dtype_that_jax_computes_in():
    # Without x64, JAX computes float64 arrays of NumPy in float32: one backend for both halves.
    double = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (GAUSSIANS, CAMERA))
    assert_array_equal(render(*double).rgb, render(GAUSSIANS, CAMERA).rgb)


def test_kernels_of_the_caller_take_the_place_of_a_backend():
    seen = []
    portable = backends.resolve("xla")

    def counted(splats, channels):
        seen.append(splats.means2d.shape)
        return portable.composite(splats, channels)

    image = render(GAUSSIANS, CAMERA, backend=replace(portable, name="mine", composite=counted))
    assert seen == [(N, 2)]
    assert_array_equal(image.rgb, render(GAUSSIANS, CAMERA, backend="xla").rgb)


def test_a_renderer_draws_what_render_does_and_passes_through_jit(backend):
    renderer = Renderer((0.1, 0.2, 0.3), Antialiasing(), backend)
    expected = render(
        GAUSSIANS, CAMERA, background=jnp.array([0.1, 0.2, 0.3]), low_pass=Antialiasing(), backend=backend
    )
    assert_array_equal(renderer(GAUSSIANS, CAMERA).rgb, expected.rgb)
    drawn = jax.jit(lambda renderer, gaussians: renderer(gaussians, CAMERA).rgb)(renderer, GAUSSIANS)
    assert_allclose(drawn, expected.rgb, atol=1e-6)
    assert hash(renderer) == hash(Renderer((0.1, 0.2, 0.3), Antialiasing(), backend))


def test_the_loss_refuses_pictures_of_two_sizes():
    with pytest.raises(ValueError, match=r"the loss: photo has shape \(4, 6, 3\)"):
        Photometric()(jnp.zeros((4, 5, 3)), jnp.zeros((4, 6, 3)))
    with pytest.raises(ValueError, match=r"the loss: mask has shape \(5, 4\)"):
        Photometric()(jnp.zeros((4, 5, 3)), jnp.zeros((4, 5, 3)), jnp.ones((5, 4), bool))


# --- the native handlers, which believe nobody ---

NATIVE = pytest.mark.skipif(cpu.BEST.why_unavailable() is not None, reason="no native library")


@cache
def recorded_calls():
    """The native calls of a small run, as (symbol, shapes of results, arrays, options)."""
    calls = []
    original = cpu.Build.call

    def record(self, symbol, shapes, arrays, **options):
        results = original(self, symbol, shapes, arrays, **options)
        options.pop(
            "aliases", None
        )  # XLA itself compares the shapes of an argument and a result in one buffer
        calls.append((symbol, shapes, [np.asarray(array) for array in arrays], options))
        return results

    with pytest.MonkeyPatch.context() as patch, jax.disable_jit():
        patch.setattr(cpu.Build, "call", record)
        for low_pass in (Dilation(), Antialiasing()):
            splats, pull_back = jax.vjp(
                lambda g, c, low_pass=low_pass: project(g, c, low_pass=low_pass, backend="cpu"),
                GAUSSIANS,
                CAMERA,
            )
            pull_back(splats)
        watched = replace(SPLATS, pull=jnp.zeros_like(SPLATS.means2d))
        jax.grad(lambda s: composite(s, s.colors, backend="cpu")[0].sum())(watched)
        photo = jnp.zeros((*SIZE[::-1], 3))
        jax.grad(lambda x: cpu.BEST.photometric(x, photo, 0.2))(photo + 0.5)
        select(SPLATS, 3, backend="cpu")
        nothing = jax.tree.map(jnp.zeros_like, GAUSSIANS)
        cpu.BEST.move(GAUSSIANS, nothing, Moments(nothing, nothing), STEP, Rule(0.9, 0.999, 1e-15), N)
        jax.jvp(lambda c: composite(SPLATS, c, backend="cpu")[0], (SPLATS.colors,), (SPLATS.colors,))
        for lens in (lenses.Pinhole(), lenses.opencv(0.1), lenses.Fisheye(jnp.zeros(4))):
            point = GAUSSIANS, replace(CAMERA, lens=lens)
            jax.jvp(lambda g, c: project(g, c, backend="cpu"), point, point)
        splats = project(GAUSSIANS, CAMERA, backend="cpu")
        found, pull_back = jax.vjp(lambda g: cpu.BEST.planes(g, CAMERA, splats), GAUSSIANS)
        pull_back(found)
        jax.jvp(lambda g: cpu.BEST.planes(g, CAMERA, splats), (GAUSSIANS,), (GAUSSIANS,))
        two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), CAMERA)
        views = jax.vmap(lambda g, c: render(g, c, backend="cpu").rgb, (None, 0))
        jax.grad(lambda g: views(g, two).sum())(GAUSSIANS)
    return calls


def in_batch(call):
    """The call for two views of which each has its own arrays."""
    symbol, shapes, arrays, options = call
    shapes = [
        (2, *shape) if isinstance(shape, tuple) else jax.ShapeDtypeStruct((2, *shape.shape), shape.dtype)
        for shape in shapes
    ]
    return symbol, shapes, [np.stack([array, array]) for array in arrays], options


@cache
def calls_and_batches():
    return recorded_calls() + [in_batch(call) for call in recorded_calls() if call[3].get("batches")]


@NATIVE
def test_every_native_kernel_and_its_gradient_is_among_the_calls():
    assert {call[0].removeprefix("splatax_") for call in recorded_calls()} == {
        "project_forward",
        "project_backward",
        "project_tangent",
        "rasterize_forward",
        "rasterize_backward",
        "rasterize_tangent",
        "select",
        "photometric",
        "scene_forward",
        "scene_backward",
        "move",
        "planes_forward",
        "planes_backward",
        "planes_tangent",
    }


@NATIVE
@settings(max_examples=300, deadline=None, derandomize=True)
@given(data=st.data())
def test_cpu_handlers_refuse_what_does_not_fit(data):
    symbol, shapes, arrays, options = data.draw(st.sampled_from(calls_and_batches()), label="call")
    shapes, arrays = list(shapes), list(arrays)
    place = data.draw(st.integers(0, len(arrays) + len(shapes) - 1), label="place")
    if place < len(arrays):
        right = arrays[place]
        if data.draw(st.integers(0, 4)) == 0:
            arrays[place] = right.astype(np.int32 if right.dtype == np.float32 else np.float32)
        else:
            wrong = data.draw(wrong_shapes(right.shape))
            if wrong == (1, *right.shape[1:]) and right.shape[:1] == (2,):
                return  # shared by the views of a batch
            degrees = {(N, k * k, 3) for k in range(1, 6)}
            if symbol in ("splatax_project_forward", "splatax_scene_forward") and wrong[-3:] in degrees:
                return  # SH of another degree
            leading = right.shape[: arrays[0].ndim - 2]
            still = (*leading, 0, *right.shape[len(leading) + 1 :])
            if symbol == "splatax_move" and place == 21 and wrong == (1,):
                return  # one learning rate for the means of all rows
            if symbol == "splatax_project_tangent" and place >= 7 and wrong == still:
                return  # the tangent of what does not move
            arrays[place] = np.ones(wrong, right.dtype)
    else:
        right = shapes[place - len(arrays)]
        shape, dtype = (right, np.float32) if isinstance(right, tuple) else (right.shape, right.dtype)
        wrong = data.draw(wrong_shapes(shape))
        if symbol == "splatax_rasterize_backward" and 0 in wrong and place == len(arrays) + 4:
            return  # an empty gradient of `pull`: not asked for
        if symbol == "splatax_scene_forward" and wrong == (2, *SIZE[::-1], 4):
            return  # with depths
        shapes[place - len(arrays)] = jax.ShapeDtypeStruct(wrong, dtype)
    with pytest.raises((jax.errors.JaxRuntimeError, ValueError), match="INVALID_ARGUMENT"):
        jax.block_until_ready(cpu.Build().call(symbol, shapes, [jnp.asarray(a) for a in arrays], **options))


@NATIVE
@pytest.mark.parametrize(
    ("symbol", "option", "value"),
    [
        ("splatax_project_forward", "width", 0),
        ("splatax_project_forward", "height", 2**40),
        ("splatax_project_tangent", "width", 0),
        ("splatax_rasterize_forward", "max_pairs", 0),
        ("splatax_rasterize_backward", "max_pairs", -1),
        ("splatax_scene_forward", "max_pairs", 0),
        ("splatax_scene_backward", "max_pairs", 2**40),
        ("splatax_move", "block", 0),
    ],
)
def test_cpu_handlers_refuse_options_out_of_range(symbol, option, value):
    _, shapes, arrays, options = next(call for call in recorded_calls() if call[0] == symbol)
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"INVALID_ARGUMENT.*not from 1 to"):
        jax.block_until_ready(
            cpu.Build().call(
                symbol, shapes, list(map(jnp.asarray, arrays)), **options | {option: np.int64(value)}
            )
        )


@NATIVE
@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (0, np.nan, "number 0 of the step is not finite"),
        (14, np.inf, "number 14 of the step is not finite"),
        (1, 1.0, r"a decay is not in \[0, 1\)"),
        (3, -0.1, r"a decay is not in \[0, 1\)"),
        (5, 0.0, "epsilon is not positive"),
    ],
)
def test_cpu_step_refuses_numbers_that_would_spoil_the_scene(place, value, words):
    symbol, shapes, arrays, options = next(call for call in recorded_calls() if call[0] == "splatax_move")
    numbers = arrays[20].copy()
    numbers[place] = value
    arrays = [*arrays[:20], numbers, *arrays[21:]]
    with pytest.raises(jax.errors.JaxRuntimeError, match=f"INVALID_ARGUMENT.*{words}"):
        jax.block_until_ready(cpu.Build().call(symbol, shapes, list(map(jnp.asarray, arrays)), **options))


@NATIVE
def test_cpu_gradient_with_the_ticket_of_another_image_bins_again():
    forward = next(call for call in recorded_calls() if call[0] == "splatax_rasterize_forward")
    backward = next(call for call in recorded_calls() if call[0] == "splatax_rasterize_backward")
    expected = cpu.Build().call(backward[0], backward[1], list(map(jnp.asarray, backward[2])), **backward[3])
    more = random_splats(n=3 * N, size=(2 * SIZE[0], SIZE[1]))
    arrays = [more.means2d, more.sqrt_conics, more.depths, more.extents, more.opacities, more.colors]
    size = (SIZE[1], 2 * SIZE[0])
    shapes = [(*size, 3), size, jax.ShapeDtypeStruct((), jnp.int32)]
    *_, ticket = cpu.Build().call(forward[0], shapes, arrays, **forward[3])
    with_its_ticket = list(map(jnp.asarray, backward[2]))
    with_its_ticket[8] = ticket
    found = cpu.Build().call(backward[0], backward[1], with_its_ticket, **backward[3])
    for a, b in zip(found, expected, strict=True):
        assert_array_equal(a, b)
