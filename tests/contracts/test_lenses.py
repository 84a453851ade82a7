"""Every lens of the registry can be inverted and differentiated, and sees points where COLMAP does."""

import math
from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import camera_at, random_gaussians
from splatax import cameras
from splatax.cameras import geometry, lenses
from splatax.cameras.motion import RollingShutter
from splatax.footprints import Ewa, Unscented
from splatax.low_pass import Dilation
from splatax.rendering import project, rasterize, render

LENSES = {  # one of each kind, with all of its coefficients
    "pinhole": lenses.Pinhole(),
    "opencv": lenses.opencv(
        -0.21, 0.06, 0.004, -0.003, 0.01, 0.02, -0.01, 0.005, 0.002, 0.001, -0.003, 0.002
    ),
    "field-of-view": lenses.FieldOfView(jnp.float32(0.9)),
    "fisheye": lenses.Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004])),
    "thin-prism-fisheye": lenses.ThinPrismFisheye(
        jnp.array([0.02, -0.01, 0.003, -0.0004]), jnp.array([0.003, -0.002]), jnp.array([0.004, 0.001])
    ),
    "rad-tan-thin-prism-fisheye": lenses.RadTanThinPrismFisheye(
        jnp.array([0.02, -0.01, 0.003, -0.0004, 1e-4, -1e-5]),
        jnp.array([0.003, -0.002]),
        jnp.array([0.004, 0.001, -0.002, 0.003]),
    ),
    "f-theta": lenses.FTheta(jnp.array([0.01, -0.03, 0.004, -0.001]), jnp.float32(1.9)),
    "equirectangular": lenses.Equirectangular(),
    "orthographic": lenses.Orthographic(),
}
SHARP = Dilation(0.0)
MOTIONS = {"still": None, "rolling": RollingShutter(jnp.array([0.02, -0.03, 0.05, 0.06, 0.02, -0.04]))}


def test_every_lens_is_held_to_this_contract():
    assert list(LENSES) == list(lenses.LENSES)
    assert all(isinstance(LENSES[name], kind) for name, kind in lenses.LENSES.items())


@pytest.fixture(params=LENSES)
def lens(request):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), LENSES[request.param])


def directions(lens, n=300, widest=1.3):
    """Random unit vectors that the lens sees, up to an angle from the axis."""
    rng = np.random.default_rng(0)
    found = rng.normal(size=(40 * n, 3))
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    found = found[np.arccos(found[:, 2]) < widest]
    return found[np.asarray(jax.jit(jax.vmap(lens.sees))(jnp.asarray(3 * found)))][:n]


@pytest.mark.slow
def test_unproject_inverts_project(x64, lens):
    wide = 2.5 if isinstance(lens, lenses.Equirectangular | lenses.Fisheye) else 1.0
    rng = np.random.default_rng(1)
    points = jnp.asarray(directions(lens, widest=wide) * rng.uniform(0.5, 20, (300, 1)))
    assert len(points) == 300

    @jax.jit
    @jax.vmap
    def round_trip(point):
        return lens.unproject(lens.project(point), lens.depth(point))

    found = round_trip(points)
    assert_allclose(found, points, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_the_inverse_has_the_derivatives_of_the_inverse(x64, lens):
    """With place, depth and coefficients: the derivative of project(unproject(x)) is that of x."""
    place, depth = jnp.array([0.31, -0.17]), jnp.asarray(2.0)

    def round_trip(lens, place, depth):
        return lens.project(lens.unproject(place, depth))

    by_lens, by_place, by_depth = jax.jit(jax.jacfwd(round_trip, argnums=(0, 1, 2)))(lens, place, depth)
    assert_allclose(by_place, np.eye(2), atol=1e-9)
    for derivative in jax.tree.leaves((by_lens, by_depth)):
        assert_allclose(derivative, 0, atol=1e-9)


@pytest.mark.slow
def test_every_coefficient_moves_the_image_and_its_jacobian_as_finite_differences_say(x64, lens):
    """Projection takes from a lens where it sees a point, and the Jacobian there."""
    points = jnp.asarray(directions(lens, n=5, widest=1.0) * 3)

    @jax.jit
    def seen(lens, points):
        return jax.vmap(lens.project)(points), jax.vmap(jax.jacfwd(lens.project))(points)

    arguments, tree = jax.tree.flatten((lens, points))
    step = 1e-6
    rng = np.random.default_rng(0)
    for i, leaf in enumerate(arguments):
        direction = jnp.asarray(rng.normal(size=leaf.shape))
        still = [jnp.zeros_like(other) for other in arguments]
        along = tree.unflatten([*still[:i], direction, *still[i + 1 :]])
        own = jax.jvp(seen, (lens, points), along)[1]
        ends = [
            seen(*tree.unflatten([*arguments[:i], leaf + sign * step * direction, *arguments[i + 1 :]]))
            for sign in (1, -1)
        ]
        finite = jax.tree.map(lambda a, b: (a - b) / (2 * step), *ends)
        for found, expected in zip(own, finite, strict=True):
            assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "motion", "method"),
    [
        # Each method with and without distortion and motion: lens, motion and method are differentiated
        # one after the other.
        ("opencv", "still", Ewa()),
        ("opencv", "still", Unscented()),
        ("equirectangular", "still", Ewa()),
        ("pinhole", "rolling", Ewa()),
        ("fisheye", "rolling", Unscented()),
    ],
)
def test_every_parameter_of_the_camera_matches_finite_differences(x64, name, motion, method):
    lens = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), LENSES[name])
    camera = wide_camera(lens, MOTIONS[motion])
    gaussians = random_gaussians(n=8, degree=1, spread=0.7, dtype=np.float64)
    rng = np.random.default_rng(3)
    seen = project(gaussians, camera, projection=method, backend="reference")
    assert np.count_nonzero(seen.extents[:, 0]) >= 5
    names = ("means2d", "sqrt_conics", "depths", "colors", "opacities")
    weights = {name: rng.normal(size=getattr(seen, name).shape) for name in names}

    @jax.jit
    def objective(arguments):
        splats = project(*arguments, projection=method, backend="reference")
        visible = splats.extents[:, 0] > 0
        return sum(
            jnp.sum(
                jnp.where(visible, 1, 0) * jnp.sum((getattr(splats, name) * weight).reshape(8, -1), axis=1)
            )
            for name, weight in weights.items()
        )

    arguments = (gaussians, camera)
    gradient = jax.grad(objective)(arguments)
    leaves, tree = jax.tree.flatten(arguments)
    named = jax.tree_util.tree_flatten_with_path(arguments)[0]
    step = 1e-6
    for i, (path, leaf) in enumerate(named):
        direction = jnp.asarray(rng.normal(size=leaf.shape))
        ends = [
            objective(tree.unflatten([*leaves[:i], leaf + sign * step * direction, *leaves[i + 1 :]]))
            for sign in (1, -1)
        ]
        finite = (ends[0] - ends[1]) / (2 * step)
        own = jnp.sum(jax.tree.leaves(gradient)[i] * direction)
        assert_allclose(own, finite, rtol=1e-5, atol=1e-6, err_msg=jax.tree_util.keystr(path))


def wide_camera(lens, motion=None, size=(64, 48)):
    """A camera with a lens, whose image shows a cloud around the origin from four units away."""
    camera = camera_at((0.4, -0.3, -4.0), size=size, focal=60.0, dtype=np.float64)
    if isinstance(lens, lenses.Orthographic):
        camera = replace(camera, fx=camera.fx / 4, fy=camera.fy / 4)
    motion = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), motion)
    return replace(camera, lens=lens, motion=motion)


@pytest.mark.slow
def test_ewa_tends_to_the_unscented_transform_as_gaussians_shrink(x64, lens):
    camera = wide_camera(lens, MOTIONS["rolling" if isinstance(lens, lenses.Pinhole) else "still"])
    differences = []
    for shrinking in (1.0, 0.1):
        gaussians = random_gaussians(n=30, degree=0, spread=0.7, scale=(0.1, 0.2), dtype=np.float64)
        gaussians = replace(gaussians, log_scales=gaussians.log_scales + math.log(shrinking))
        ewa, unscented = (
            project(gaussians, camera, projection=method, low_pass=SHARP, backend="reference")
            for method in (Ewa(), Unscented())
        )
        visible = np.asarray((ewa.extents[:, 0] > 0) & (unscented.extents[:, 0] > 0))
        assert visible.sum() > 15
        apart = np.abs(np.asarray(ewa.sqrt_conics - unscented.sqrt_conics)[visible])
        differences.append(
            (apart / np.abs(np.asarray(ewa.sqrt_conics)[visible]).max(axis=1, keepdims=True)).max()
        )
    # The difference is of second order in the size, and nothing for parallel projection.
    assert differences[1] < max(0.02 * differences[0], 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "motion", "method"),
    # A moving camera gives a lens other points, the unscented transform more of them: nothing of the lens.
    [
        *((name, "still", Ewa()) for name in LENSES),
        ("pinhole", "rolling", Ewa()),
        ("opencv", "still", Unscented()),
        ("fisheye", "rolling", Unscented()),
    ],
)
def test_a_picture_is_finite_with_finite_gradients_wherever_gaussians_are(name, motion, method):
    """All around the camera, at it, behind it, and beyond the fold of a distortion."""
    camera = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float32), wide_camera(LENSES[name]))
    camera = replace(camera, cam_from_world=jnp.eye(4), motion=MOTIONS[motion])
    around = random_gaussians(n=200, degree=1, spread=2.0)
    special = jnp.array(
        [[0, 0, 0], [0, 0, -1], [0, 0, 1], [0, 1, 0], [0, -2, 1e-20], [1e30, 0, 1], [1, 1, 0.0]]
    )
    around = replace(around, means=around.means.at[: len(special)].set(special))

    seen = project(around, camera, projection=method, backend="xla")
    value, cotangent = light(seen)
    assert value > 0
    gradient = pulled_back(around, camera, cotangent, method)
    for path, leaf in jax.tree_util.tree_flatten_with_path(gradient)[0]:
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@jax.jit
@jax.value_and_grad
def light(splats):
    """Of a picture, and its gradient: one program, whatever the lens."""
    drawn = rasterize(splats, backend="xla")
    return jnp.sum(drawn.rgb) + jnp.sum(drawn.depth)


@partial(jax.jit, static_argnames="method")
def pulled_back(gaussians, camera, cotangent, method):
    """The gradient of splats in scene and camera."""
    return jax.vjp(partial(project, projection=method, backend="xla"), gaussians, camera)[1](cotangent)


def test_coefficients_of_the_wrong_shape_are_refused(lens):
    arrays = [field.name for field in fields(lens) if getattr(lens, field.name).ndim == 1]
    for name in arrays:
        longer = replace(lens, **{name: jnp.zeros(9)})
        with pytest.raises(ValueError, match=f"lens.{name}"):
            cameras.checked(replace(camera_at(), lens=longer))


def test_something_that_is_no_lens_is_refused():
    with pytest.raises(ValueError, match="not a lens"):
        cameras.checked(replace(camera_at(), lens=jnp.zeros(4)))


COLMAP = {  # name of a lens -> COLMAP's model, and its parameters in its own order, from ours
    "pinhole": ("PINHOLE", lambda lens: []),
    "opencv": (
        "FULL_OPENCV",
        lambda lens: [*lens.radials[:2], *lens.tangentials, *lens.radials[2:]],
    ),
    "field-of-view": ("FOV", lambda lens: [lens.angle]),
    "fisheye": ("OPENCV_FISHEYE", lambda lens: [*lens.radials]),
    "thin-prism-fisheye": (
        "THIN_PRISM_FISHEYE",
        lambda lens: [*lens.radials[:2], *lens.tangentials, *lens.radials[2:], *lens.prism],
    ),
    "rad-tan-thin-prism-fisheye": (
        "RAD_TAN_THIN_PRISM_FISHEYE",
        lambda lens: [*lens.radials, *lens.tangentials, *lens.prism],
    ),
}


@pytest.mark.parametrize("name", COLMAP)
def test_a_point_is_seen_where_colmap_sees_it(x64, name):
    pycolmap = pytest.importorskip("pycolmap")
    lens = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), LENSES[name])
    if name == "opencv":  # COLMAP's has no prism
        lens = replace(lens, prism=jnp.zeros(4))
    model, parameters = COLMAP[name]
    values = [50.0, 52.0, 31.0, 25.0, *map(float, parameters(lens))]
    camera = pycolmap.Camera(model=model, width=64, height=48, params=values)
    points = directions(lens, n=200, widest=1.0)
    expected = np.asarray(camera.img_from_cam(points))
    focal, center = np.array([50.0, 52.0]), np.array([31.0, 25.0])
    assert_allclose(
        np.asarray(jax.vmap(lens.project)(jnp.asarray(points))) * focal + center, expected, rtol=1e-9
    )


def test_a_distortion_that_folds_shows_nothing_twice(x64):
    """Beyond the radius where k1 turns the image back inwards, a point would land inside the picture."""
    lens = lenses.opencv(-0.3, dtype="float64")  # r (1 - 0.3 r^2) grows up to r = 1.054
    radii = np.array([0.5, 1.0, 1.1, 1.5, 3.0])
    seen = [bool(lens.sees(jnp.array([radius, 0.0, 1.0]))) for radius in radii]
    assert seen == [True, True, False, False, False]


def test_a_panorama_draws_what_crosses_its_seam_on_both_sides():
    whole = panorama(jnp.eye(4), 64)
    behind = random_gaussians(n=1, degree=0)
    behind = replace(behind, means=jnp.array([[0.0, 0.3, -2.0]]), log_scales=jnp.full((1, 3), jnp.log(0.3)))
    for backend in ("reference", "xla"):
        alpha = render(behind, whole, backend=backend).alpha
        assert alpha[:, 0].max() > 0.1
        assert alpha[:, -1].max() > 0.1
        turned = jnp.eye(4).at[0, 0].set(-1).at[2, 2].set(-1)  # half a turn: the seam becomes the middle
        assert_allclose(jnp.roll(render(behind, panorama(turned, 64)).alpha, 32, axis=1), alpha, atol=1e-4)


def panorama(pose, width):
    height = width // 2
    f = jnp.float32(width / (2 * math.pi))
    center = jnp.float32(width / 2), jnp.float32(height / 2)
    return cameras.Camera(f, f, *center, pose, width, height, lens=lenses.Equirectangular())


def test_a_rolling_shutter_sees_each_row_from_its_own_pose(x64):
    camera = wide_camera(lenses.Pinhole(), MOTIONS["rolling"])
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.7, 0.7, (50, 3)))
    pixels = jax.jit(jax.vmap(lambda point: camera.to_pixel(camera.to_camera(point))))(points)
    for point, pixel in zip(points, pixels, strict=True):
        time = jnp.clip(pixel[1] / camera.height, 0, 1) - 0.5
        pose = camera.at(time)
        assert_allclose(pose.to_pixel(pose.to_camera(point)), pixel, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "motion"),
    # Without motion, the poses of all rows are one: a matter of rays that meet and of parallel ones.
    [*((name, "rolling") for name in LENSES), ("opencv", "still"), ("orthographic", "still")],
)
def test_every_ray_is_seen_at_its_pixel(x64, name, motion):
    lens = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), LENSES[name])
    camera = replace(wide_camera(lens, MOTIONS[motion]), width=8, height=6)
    camera = replace(camera, cx=jnp.asarray(4.0), cy=jnp.asarray(3.0))

    @jax.jit
    def ray_and_pixel(camera):
        there, ray = camera.at(jnp.asarray(2.5 / 6 - 0.5)), geometry.rays(camera)[2, 5]
        if not lens.CENTRAL:
            return ray, there.rotation[2]
        return camera.to_pixel(camera.to_camera(there.position + 3 * ray)), jnp.array([5.5, 2.5])

    found, expected = ray_and_pixel(camera)
    assert_allclose(found, expected, atol=1e-6 if lens.CENTRAL else 1e-12)


def test_behind_the_pole_of_a_rational_distortion_nothing_is_seen(x64):
    """r / (1 - 0.5 r^2) grows everywhere, but begins again at minus infinity behind r = 1.41."""
    lens = lenses.opencv(0.0, 0.0, 0.0, 0.0, 0.0, -0.5, dtype="float64")
    seen = [bool(lens.sees(jnp.array([radius, 0.0, 1.0]))) for radius in (0.5, 1.3, 1.5, 3.0)]
    assert seen == [True, True, False, False]


@pytest.mark.slow
def test_a_pixel_beyond_the_fold_looks_along_the_fold(x64):
    lens = lenses.opencv(-0.3, dtype="float64")  # the image ends at radius 0.703, of slope 1.054
    for radius in (0.71, 1.0, 5.0):
        assert_allclose(lens.unproject(jnp.array([radius, 0]), jnp.asarray(1.0)), [1.054, 0, 1], atol=0.03)
