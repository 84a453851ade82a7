"""Photos of many sizes share a few compiled programs, and give the results of programs of their own size."""

from contextlib import contextmanager
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import losses
from splatax.backends.projection_kernels import kernel_for
from splatax.cameras import RollingShutter, panorama
from splatax.cameras.canvases import canvases_for
from splatax.cameras.lenses import Fisheye, OpenCV, Orthographic, Pinhole, opencv
from splatax.dataset import hold_out
from splatax.evaluation import MOST_SIZES, picture
from splatax.low_pass import AlongRays
from splatax.training.backgrounds import Solid
from splatax.training.canvases import filling
from splatax.training.density import Classic, NoDensityControl
from splatax.training.disc_geometry import DiscGeometry
from splatax.training.feed import batch, batches
from splatax.training.geometry import NoGeometry, Surfaces
from splatax.training.groups import steps_of
from splatax.training.loop import first_state
from splatax.training.photo_cache import PhotoCache
from splatax.training.recipes import Objective, ShSchedule, with_views
from splatax.training.resolution import Resolution
from splatax.training.schedule import Schedule
from splatax.training.step import compare
from splatax.training.steppers import MOST_PROGRAMS, stepper_for

TRUTH = random_gaussians(n=60, degree=0, spread=0.8, scale=(0.05, 0.25))
RECIPE = sx.Recipe(steps=50, density=NoDensityControl(), sh=ShSchedule(0)).on("xla")
CANVAS = (64, 48)
SURFACES = Surfaces(spread=0.3, consistency=0.2, points=0.4, consistency_limit=0.5, after=0.0)
DISCS = DiscGeometry(distortion_from=0.0, consistency_from=0.0)


def camera_of(size, lens=None, at=0.0):
    camera = camera_at((4 * np.sin(at), 0.4, -4 * np.cos(at)), size=size, focal=45.0)
    return camera if lens is None else replace(camera, lens=lens)


def view_of(name, camera, masked=False, seed=0):
    rng = np.random.default_rng(seed)
    photo = rng.integers(0, 255, (camera.height, camera.width, 3), np.uint8)
    mask = rng.uniform(size=photo.shape[:2]) > 0.3
    return sx.View(name, camera, lambda: photo, (lambda: mask) if masked else None)


def of_many_sizes(count=50):
    """A capture whose photos all have different sizes."""
    rng = np.random.default_rng(0)
    sizes = {(int(w), int(h)) for w, h in rng.integers(20, 60, (3 * count, 2))}
    views = [
        view_of(f"{i:02}.png", camera_of(size, at=0.02 * i), seed=i)
        for i, size in enumerate(sorted(sizes)[:count])
    ]
    train, test = hold_out(views)
    points = sx.PointCloud(np.asarray(TRUTH.means), np.full((60, 3), 0.5, np.float32))
    return sx.Dataset(train, test, points)


def schedule_of(recipe):
    return Schedule(recipe.steps, recipe.steps, recipe.resolution)


def test_canvases_cover_their_photos_and_are_few():
    sizes = [(w, h) for w in range(20, 60, 3) for h in (30, 37, 44)]
    cameras = [camera_of(size) for size in sizes]
    for most in (1, 2, 4):
        canvases = canvases_for(cameras, most)
        assert len(set(canvases)) == most
        for size, canvas in zip(sizes, canvases, strict=True):
            assert canvas[0] >= size[0]
            assert canvas[1] >= size[1]
    # canvases have no pixel more than their largest photos need
    used = {
        c: np.max([s for s, own in zip(sizes, canvases, strict=True) if own == c], axis=0) for c in canvases
    }
    assert all(canvas == tuple(most) for canvas, most in used.items())


def test_upright_and_wide_photos_do_not_share_a_canvas():
    sizes = [(60 + i, 40) for i in range(3)] + [(40, 60 + i) for i in range(3)]
    canvases = canvases_for([camera_of(size) for size in sizes], 2)
    assert canvases == [(62, 40)] * 3 + [(40, 62)] * 3


def test_very_many_sizes_are_covered_too():
    rng = np.random.default_rng(0)
    sizes = [(int(w), int(h)) for w, h in rng.integers(500, 4000, (2000, 2))]
    camera = camera_of((8, 8))
    canvases = canvases_for([replace(camera, width=w, height=h) for w, h in sizes], 4)
    assert len(set(canvases)) == 4
    assert all(w <= canvas[0] and h <= canvas[1] for (w, h), canvas in zip(sizes, canvases, strict=True))


def test_a_capture_of_few_sizes_or_of_panoramas_has_no_canvases():
    few = [camera_of((30 + i % 3, 20)) for i in range(9)]
    assert canvases_for(few, 3) == [None] * 9
    whole = [panorama(few[0].cam_from_world, 2 * h, h) for h in range(20, 30)]
    assert canvases_for([*few, *whole], 3) == [None] * 19
    with pytest.raises(ValueError, match="repeats"):
        whole[0].on_canvas(100, 100)
    with pytest.raises(ValueError, match="does not fit"):
        few[0].on_canvas(29, 40)


@pytest.mark.parametrize(
    ("lens", "backend"),
    [(None, "auto"), (opencv(-0.1, 0.02), "auto"), (Fisheye(jnp.zeros(4)), "auto"), (opencv(-0.1), "xla")],
)
def test_a_view_on_a_canvas_has_the_splats_of_the_view(lens, backend):
    """Culling and the limit of linearization are those of the photo, not of the canvas."""
    wide = random_gaussians(n=200, degree=0, spread=3.0, scale=(0.05, 0.5))
    camera = camera_of((40, 32), lens)
    own = sx.project(wide, camera, backend=backend)
    shared = sx.project(wide, camera.on_canvas(*CANVAS), backend=backend)
    drawn = np.asarray(own.extents[:, 0] > 0)
    assert 50 < drawn.sum() < 200
    assert_array_equal(drawn, shared.extents[:, 0] > 0)
    for one, other in zip(jax.tree.leaves(own), jax.tree.leaves(shared), strict=True):
        assert_allclose(one[drawn], other[drawn], rtol=1e-3, atol=1e-4)  # kernels round differently


@dataclass(frozen=True)
class Named:
    """A projection kernel that is never called."""

    name: str
    shares_scenes = True

    def forward(self, shapes, arrays, options):
        raise NotImplementedError

    gradient = tangent = forward


def test_the_projections_of_a_backend_serve_canvases():
    """A pinhole on a canvas is OpenCV's lens to them, because that is packed with the box of its frame."""
    kernels = {lens: Named(lens.__name__) for lens in (Pinhole, OpenCV, Fisheye)}
    expected = [
        (Pinhole(), Pinhole, OpenCV),
        (opencv(), OpenCV, OpenCV),
        (Fisheye(jnp.zeros(4)), Fisheye, Fisheye),
        (Orthographic(), None, None),
    ]
    for lens, own, shared in expected:
        camera = camera_of((40, 32), lens)
        assert kernel_for(camera, kernels) == kernels.get(own)
        assert kernel_for(camera.on_canvas(*CANVAS), kernels) == kernels.get(shared)
    moving = replace(camera_of((40, 32)), motion=RollingShutter(jnp.zeros(6)))
    assert kernel_for(moving.on_canvas(*CANVAS), kernels) is None


@pytest.mark.slow
@pytest.mark.parametrize("lens", [None, opencv(-0.1, 0.02), Fisheye(jnp.zeros(4))])
def test_gradients_through_a_canvas_are_those_of_the_portable_projection(lens):
    """With respect to the scene and the camera, whose frame moves the limit of linearization."""
    wide = random_gaussians(n=200, degree=0, spread=3.0, scale=(0.05, 0.5))
    camera = camera_of((40, 32), lens).on_canvas(*CANVAS)

    def pulled(backend):
        splats, pull = jax.vjp(lambda *seen: sx.project(*seen, backend=backend), wide, camera)
        drawn, rng = np.asarray(splats.extents[:, 0] > 0), np.random.default_rng(0)

        def weighted(leaf):
            return jnp.asarray((rng.normal(size=leaf.shape).T * drawn).T, leaf.dtype)

        return drawn, pull(jax.tree.map(weighted, splats))

    (drawn, found), (expected_drawn, expected) = pulled("auto"), pulled("xla")
    assert_array_equal(drawn, expected_drawn)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(one, other, rtol=1e-3, atol=1e-4 * float(jnp.max(jnp.abs(other))) + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frame", "backend"),
    [  # plain JAX has one formula for frames of any size; kernels have tiles and borders
        ((9, 46), "xla"),
        *((frame, "auto") for frame in [(40, 32), (64, 48), (61, 48), (9, 46), (64, 3)]),
    ],
)
def test_the_loss_on_a_canvas_is_that_of_the_pictures_without_it(frame, backend):
    width, height = frame
    rng = np.random.default_rng(0)
    image, photo = jnp.asarray(rng.uniform(size=(2, height, width, 3)), jnp.float32)
    rest = ((0, CANVAS[1] - height), (0, CANVAS[0] - width), (0, 0))
    kernel = sx.backends.resolve(backend).photometric

    def on_canvas(image):
        return losses.photometric_on_canvas(
            jnp.pad(image, rest),
            jnp.pad(photo, rest),
            0.2,
            frame=jnp.array(frame, jnp.float32),
            kernel=kernel,
        )

    expected, slope = jax.jit(jax.value_and_grad(lambda image: kernel(image, photo, 0.2)))(image)
    found, found_slope = jax.jit(jax.value_and_grad(on_canvas))(image)
    fills = width * height / (CANVAS[0] * CANVAS[1])
    assert_allclose(found / fills, expected, rtol=2e-6)
    assert_allclose(found_slope / fills, slope, atol=2e-6 * float(jnp.max(jnp.abs(slope))))


def with_geometry(recipe, geometry):
    """The recipe with penalties of geometry; those of discs draw along rays, as the preset does."""
    recipe = replace(recipe, objective=Objective(geometry=geometry))
    along = isinstance(geometry, DiscGeometry)
    return replace(recipe, drawing=replace(recipe.drawing, low_pass=AlongRays())) if along else recipe


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "masked", "geometry"),
    [
        (None, True, NoGeometry()),
        (opencv(-0.1, 0.02), False, NoGeometry()),
        (None, False, SURFACES),
        (None, True, DISCS),
    ],
)
def test_a_step_on_a_canvas_is_the_step_on_the_photo(lens, masked, geometry):
    view = view_of("a", camera_of((40, 32), lens), masked)
    recipe = with_geometry(RECIPE, geometry).on(sx.backends.resolve("auto"))
    blue = Solid((0.2, 0.4, 0.6))
    recipe = replace(recipe, drawing=replace(recipe.drawing, background=blue))
    found = []
    for canvases in (None, [CANVAS]):
        state = first_state(jax.tree.map(jnp.array, TRUTH), recipe, 1.0, 1)
        frame = PhotoCache([view], np.inf, canvases).frame(0, 1)
        seen = batch(*frame, next(iter(batches([view], 0))).source, 1, np.asarray(TRUTH.means))
        assert seen.photo.shape[:2] == ((32, 40) if canvases is None else CANVAS[::-1])
        compared = compare(state, seen, recipe, jax.random.key(0))
        observed = filling(compared.shown.splats, compared.d_shown.splats, seen.camera.frame)
        density = Classic().observe(Classic().init(len(TRUTH)), *observed)
        found.append((compared.loss, compared.pull_back(compared.d_shown)[0], density))
    # Planes refer to the middle of the image, which differs: their sums are rounded differently.
    close = 1e-4 if geometry.outputs else 2e-6
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        assert_allclose(one, other, rtol=1e-4, atol=close * float(jnp.max(jnp.abs(one))) + 1e-12)


@contextmanager
def compilations():
    """The names of the functions that are compiled meanwhile, each as often as it is."""
    names = []

    def listen(event, _, **details):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(details["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stages", "geometry"),
    [((), NoGeometry()), (((25, 2),), NoGeometry()), ((), SURFACES), ((), DISCS)],
)
def test_a_capture_of_fifty_sizes_compiles_at_most_four_programs(stages, geometry):
    dataset = of_many_sizes(50)
    sizes = {(view.camera.width, view.camera.height) for view in dataset.train}
    assert len(sizes) == len(dataset.train) > 40
    recipe = replace(with_geometry(RECIPE, geometry), resolution=Resolution(stages))
    recipe = recipe.on(sx.backends.resolve("auto"))
    stepper = stepper_for(recipe, None)
    state = first_state(jax.tree.map(jnp.array, TRUTH), recipe, 1.0, len(dataset.train))
    feed = stepper.feed(dataset.train, recipe, 0, schedule_of(recipe), np.inf)
    with compilations() as compiled:
        for _ in range(recipe.steps):
            state, loss = stepper.step(state, next(feed), recipe)
            assert np.isfinite(loss)
    feed.close()
    assert 1 < sum("_train_step" in name for name in compiled) <= MOST_PROGRAMS == 4


def test_steps_on_several_views_take_photos_of_different_sizes():
    dataset, recipe = of_many_sizes(12), with_views(RECIPE, 2)
    stepper = stepper_for(recipe, jax.devices()[:1])
    feed = stepper.feed(dataset.train, recipe, 0, schedule_of(recipe), np.inf)
    steps = [next(feed) for _ in range(10)]
    feed.close()
    assert len({views.photo.shape for views in steps}) <= MOST_PROGRAMS
    assert any(np.ptp(views.camera.frame, axis=0).any() for views in steps)
    for views in steps:
        for frame, photo in zip(views.camera.frame, views.photo, strict=True):
            width, height = np.asarray(frame).astype(int)
            assert np.all(photo[:height, :width, 3] == 255)
            assert photo[..., 3].sum() == 255 * width * height


@pytest.mark.slow
def test_a_step_on_several_canvases_learns_the_same_on_each_number_of_views():
    """Two views of a step on canvases give the mean of their gradients on their own sizes."""
    dataset = of_many_sizes(12)
    recipe = replace(with_views(RECIPE, 2), density=Classic()).on(sx.backends.resolve("auto"))
    found = []
    for canvases in (None, [CANVAS] * len(dataset.train)):
        same = [view_of(v.name, camera_of((40, 32), at=0.1 * i), seed=i) for i, v in enumerate(dataset.train)]
        stepper = stepper_for(recipe, jax.devices()[:1])
        photos = PhotoCache(same, np.inf, canvases)
        views = next(steps_of(same, recipe, 0, Resolution(), stepper.sharding, photos))
        state = stepper.placed(first_state(jax.tree.map(jnp.array, TRUTH), recipe, 1.0, len(same)))
        state, loss = stepper.step(state, views, recipe)
        state = stepper.gathered(state, len(TRUTH))
        found.append((loss, state.density_state, state.opt_state))
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        scale = float(jnp.max(jnp.abs(one))) if one.size else 0.0
        assert_allclose(one, other, rtol=1e-3, atol=1e-5 * scale + 1e-12)


@pytest.mark.slow
def test_evaluation_of_many_sizes_compiles_few_programs_and_scores_the_same():
    views = of_many_sizes(30).train
    sizes = len({(view.camera.width, view.camera.height) for view in views})
    assert sizes > MOST_SIZES
    scene = sx.Gaussians(*jax.tree.leaves(TRUTH))
    with compilations() as compiled:
        scores = sx.evaluate(scene, views, renderer=sx.Renderer(backend="xla"))
    assert sum("_finish" in name for name in compiled) <= MOST_SIZES
    assert sum("_project" in name for name in compiled) <= MOST_SIZES
    assert len(compiled) < sizes
    for view, score in zip(views[:2], scores.views, strict=False):
        image = picture(scene, view.camera, sx.Renderer(backend="xla"))
        assert score.psnr == pytest.approx(sx.metrics.psnr(image, view.pixels()), abs=1e-3)
