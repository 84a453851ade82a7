"""Every sensor of the registry measures the truth of a scene that is known, alone and in a rig."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import RED, camera_at, plane_of_gaussians
from splatax import sensors
from splatax.cameras import RollingShutter
from splatax.cameras.geometry import ray, rays
from splatax.cameras.lenses import Fisheye
from splatax.sensors import CameraRig, Color, Depth, Labels, Lidar, Normals, PointCloud, observe
from splatax.transforms import Similarity

NORMAL = np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])
PLANE = plane_of_gaussians(NORMAL, n=2000, half=2.0, sigma=0.08)
SCENE = sx.Scene({"plane": sx.Part(PLANE)})
PINHOLE = camera_at((0.3, 0.2, -3.0), size=(24, 18))
FISHEYE = replace(PINHOLE, lens=Fisheye(jnp.array([0.02, -0.01, 0.003, -0.0004], jnp.float32)))
MOVING = replace(PINHOLE, motion=RollingShutter(jnp.array([0.0, 0, 0, 0.3, 0.1, 0], jnp.float32)))
CAMERAS = {"pinhole": PINHOLE, "fisheye": FISHEYE, "rolling shutter": MOVING}
TABLE = sensors.spinning(np.radians([-8.0, 0.0, 8.0]), 90)
SENSORS = {
    "color": Color(),
    "depth": Depth(),
    "normals": Normals(),
    "labels": Labels(),
    "points": PointCloud(),
    "lidar": Lidar(jnp.asarray(TABLE), height=64),
}
TOLERANCE = {"pinhole": 1e-5, "rolling shutter": 5e-3, "fisheye": 5e-3}
# Planes are exact through a pinhole, and to first order in the size of a Gaussian through other lenses.


def meeting(camera):
    """Returns the points [h w 3] where the rays of the pixels meet the plane, and their distances."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = jnp.asarray(np.stack([x, y], axis=-1), jnp.float32)
    origin, direction = jax.vmap(jax.vmap(lambda pixel: ray(camera, pixel)))(pixels)
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    distance = -(origin @ NORMAL) / (direction @ NORMAL)
    return origin + distance[..., None] * direction, distance


def local(camera, points):
    pose = np.asarray(camera.cam_from_world, np.float64)
    return points @ pose[:3, :3].T + pose[:3, 3]


def test_every_sensor_is_held_to_this_contract():
    assert list(SENSORS) == list(sensors.SENSORS)
    for name, kind in sensors.SENSORS.items():
        assert isinstance(SENSORS[name], kind)
        assert isinstance(SENSORS[name], sensors.Sensor)


@pytest.fixture(scope="module", params=CAMERAS)
def measured(request):
    camera = CAMERAS[request.param]
    asked = {
        "axis": Depth(invalid=math.nan),
        "ray": Depth(along="ray", invalid=math.nan),
        "points": PointCloud(frame="sensor"),
        "world": PointCloud(frame="world"),
        "normals": Normals(),
        "facing": Normals(frame="world"),
        "labels": Labels(),
    }
    found = jax.jit(lambda scene: observe(scene, camera, asked))(SCENE)
    return camera, {name: np.asarray(value) for name, value in found.items()}, TOLERANCE[request.param]


@pytest.mark.slow
def test_depth_along_the_ray_and_the_axis_points_and_labels_are_those_of_the_plane(measured):
    camera, found, rtol = measured
    points, distance = meeting(camera)
    seen = ~np.isnan(found["ray"])
    assert seen.mean() > 0.6
    assert_allclose(found["ray"][seen], distance[seen], rtol=rtol)
    assert_allclose(found["world"][seen], points[seen], atol=5 * rtol)
    if camera.motion is None:  # the axis of a camera that moves is that of the row's own moment
        assert_allclose(found["axis"][seen], local(camera, points)[..., 2][seen], rtol=rtol, atol=rtol)
    assert_allclose(found["points"][seen], local(camera, points)[seen], atol=5 * rtol)
    assert np.isnan(found["points"][~seen]).all()
    assert_array_equal(found["labels"][seen], 0)
    assert set(np.unique(found["labels"])) <= {-1, 0}


@pytest.mark.slow
def test_normals_are_unit_vectors_of_the_frame_that_is_asked_for(measured):
    camera, found, rtol = measured
    seen = np.linalg.norm(found["facing"], axis=-1) > 0
    turned = np.asarray(camera.rotation, np.float64) @ NORMAL
    for name, truth in (("facing", NORMAL), ("normals", turned)):
        assert_allclose(found[name][seen], np.broadcast_to(truth, (seen.sum(), 3)), atol=10 * rtol)


def test_a_lidar_measures_the_plane_along_every_ray_of_its_table_in_both_frames():
    asked = {
        "lidar": Lidar(jnp.asarray(3 * TABLE), height=96),
        "world": Lidar(jnp.asarray(TABLE), height=96, frame="world"),
    }
    found = jax.jit(lambda scene: observe(scene, PINHOLE, asked))(SCENE)
    scan = jax.tree.map(np.asarray, found["lidar"])
    met = ~np.isnan(scan.ranges)
    along = TABLE @ np.asarray(PINHOLE.rotation, np.float64)
    truth = -(np.asarray(PINHOLE.position, np.float64) @ NORMAL) / (along @ NORMAL)
    assert met.sum() > 30
    assert (truth[met] > 0).all()
    assert_allclose(scan.ranges[met], truth[met], rtol=2e-2)
    assert np.median(np.abs(scan.ranges / truth - 1)[met]) < 4e-3
    assert_allclose(scan.points[met], truth[met, None] * TABLE[met], atol=6e-2)
    world = np.asarray(PINHOLE.position) + truth[met, None] * along[met]
    assert_allclose(found["world"].points[met], world, atol=6e-2)
    assert_array_equal(scan.rows >= 0, met)


@pytest.mark.slow
def test_a_rig_measures_what_its_cameras_do_one_by_one_with_every_sensor():
    cameras = [PINHOLE, camera_at((-0.4, 0.1, -2.5), size=(24, 18))]
    rig = CameraRig.of(cameras, ("left", "right"))
    place = Similarity.of(degrees=(3.0, -5.0, 2.0), move=(0.1, 0.2, -0.1))
    key = jax.random.key(0)
    together = jax.jit(lambda place: observe(SCENE, rig.at(place), SENSORS, key=key))(place.cast(jnp.float32))
    alone_in = jax.jit(lambda camera, key: observe(SCENE, camera, SENSORS, key=key))
    for i, (camera, own) in enumerate(zip(cameras, jax.random.split(key, 2), strict=True)):
        alone = alone_in(place.transform_camera(camera), own)
        assert jax.tree.structure(alone) == jax.tree.structure(together)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            differs = ~np.isclose(np.asarray(a[i]), np.asarray(b), atol=1e-3, rtol=1e-3, equal_nan=True)
            assert differs.mean() < 0.02  # a pixel at the threshold of half a cover may fall either way


def test_pixels_out_of_range_or_without_a_surface_hold_the_invalid_value():
    away = camera_at((0.3, 0.2, -3.0), target=(0, 0, -9.0), size=(24, 18))
    asked = {"zero": Depth(), "nan": Depth(invalid=math.nan), "near": Depth(most=2.0), "label": Labels()}
    found = observe(SCENE, away, asked)
    assert_array_equal(found["zero"], 0)
    assert np.isnan(found["nan"]).all()
    assert_array_equal(found["label"], -1)
    assert_array_equal(observe(SCENE, PINHOLE, asked)["near"], 0)


def test_labels_of_gaussians_are_those_of_the_nearest_opaque_ones():
    front = replace(PLANE, means=PLANE.means * 0.4 - 0.8 * jnp.asarray(NORMAL, jnp.float32)[None] * -1)
    scene = sx.editing.merge([PLANE, front])
    rows = jnp.repeat(jnp.array([0, 1]), len(PLANE))
    seen = observe(scene, PINHOLE, {"labels": Labels(rows, 2)})["labels"]
    parts = sx.Scene({"back": sx.Part(PLANE), "front": sx.Part(front)})
    assert_array_equal(seen, observe(parts, PINHOLE, {"labels": Labels()})["labels"])
    assert seen[9, 12] == 1
    assert {0, 1} <= set(np.unique(seen).tolist())
    with pytest.raises(ValueError, match="have no parts"):
        observe(PLANE, PINHOLE, {"labels": Labels()})
    with pytest.raises(ValueError, match="labels of shape"):
        observe(PLANE, PINHOLE, {"labels": Labels(rows, 2)})


def test_color_noise_has_the_mean_and_the_variance_of_its_model():
    noise = sensors.ColorNoise(exposure=0.5, gain=1.5, full_well=500.0, read=4.0)
    light = jnp.full((64, 64, 3), 0.4)
    values = np.asarray(noise.apply(light, jax.random.key(1)), np.float64)
    electrons = 500 * 0.5 * 0.4
    assert_allclose(values.mean(), 1.5 * electrons / 500, rtol=2e-3)
    assert_allclose(values.std(), 1.5 * math.sqrt(electrons + 16) / 500, rtol=2e-2)  # of 12,288 samples
    assert_allclose(noise.apply(light, None), 0.3, rtol=1e-6)


def test_exposure_and_gain_that_cancel_leave_the_picture_as_it_is():
    red = replace(PLANE, sh=PLANE.sh.at[:, 0].set(jnp.asarray(RED - 0.3, jnp.float32)))
    plain = observe(red, PINHOLE, {"c": Color()})["c"]
    noise = sensors.ColorNoise(exposure=0.25, gain=4.0)
    assert_allclose(observe(red, PINHOLE, {"c": Color(noise)})["c"], plain, atol=2e-5)
    noisy = observe(red, PINHOLE, {"c": Color(noise)}, key=jax.random.key(0))["c"]
    assert 1e-3 < np.abs(noisy - plain).mean() < 0.1


def test_motion_blur_spreads_an_edge_by_the_motion_and_keeps_the_light():
    half = jax.tree.map(lambda leaf: leaf[np.asarray(PLANE.means[:, 0]) > 0], PLANE)
    half = replace(half, sh=half.sh + 1.0)
    blur = sensors.MotionBlur(jnp.array([0.0, 0.15, 0, 0, 0, 0], jnp.float32), samples=6)
    found = observe(half, PINHOLE, {"sharp": Color(), "blurred": Color(blur=blur)})
    steps = {name: np.abs(np.diff(np.asarray(value[..., 0]), axis=1)).max() for name, value in found.items()}
    assert steps["blurred"] < 0.75 * steps["sharp"]
    still = sensors.MotionBlur(jnp.zeros(6, jnp.float32), samples=3)
    assert_allclose(observe(half, PINHOLE, {"c": Color(blur=still)})["c"], found["sharp"], atol=1e-4)


def test_depth_noise_grows_with_the_square_of_depth_and_drops_edges_and_grazing_surfaces():
    noise = sensors.DepthNoise(least=0.001, quadratic=0.01, nearest=0.5, dropout=0.25)
    depth, facing = jnp.full((80, 80), 2.5), jnp.ones((80, 80))
    valid = jnp.ones((80, 80), bool)
    noisy, kept = noise.apply(depth, facing, valid, jax.random.key(0))
    assert_allclose(np.std(np.asarray(noisy)), 0.001 + 0.01 * 2.0**2, rtol=3e-2)
    assert_allclose(np.asarray(kept).mean(), 0.75, atol=0.02)
    certain = replace(noise, dropout=0.0)
    grazing = jnp.full((80, 80), math.cos(1.5))
    assert not np.asarray(certain.apply(depth, grazing, valid, jax.random.key(0))[1]).any()
    stepped = depth.at[:, 40:].set(4.0)
    kept = np.asarray(certain.apply(stepped, facing, valid, jax.random.key(0))[1])
    assert not kept[:, 40].any()  # the far side of the edge
    assert kept[:, :40].all()
    assert kept[:, 41:].all()


def test_the_same_key_gives_the_same_noise_and_noise_needs_a_key():
    asked = {"depth": Depth(sensors.DepthNoise())}
    first, again = (observe(SCENE, PINHOLE, asked, key=jax.random.key(3))["depth"] for _ in range(2))
    assert_array_equal(first, again)
    other = observe(SCENE, PINHOLE, asked, key=jax.random.key(4))["depth"]
    assert (np.asarray(first) != np.asarray(other)).any()
    assert_array_equal(
        observe(SCENE, PINHOLE, asked)["depth"], observe(SCENE, PINHOLE, {"depth": Depth()})["depth"]
    )


def test_a_pose_has_a_gradient_through_a_depth_image():
    seen = rays(PINHOLE)[9, 12]

    def central(x):
        place = Similarity(jnp.eye(3), x * jnp.asarray(NORMAL, jnp.float32))
        image = observe(SCENE.posed({"plane": place}), PINHOLE, {"depth": Depth(along="ray")})["depth"]
        return image[9, 12]

    slope = jax.grad(central)(jnp.float32(0.0))
    assert_allclose(slope, 1 / (np.asarray(seen) @ NORMAL), rtol=1e-3)  # of the ray to a plane that moves


def test_measurements_have_the_shapes_and_kinds_of_the_docs_for_a_camera_and_for_a_rig():
    rays = len(TABLE)
    expected = {
        "color": ((18, 24, 3), "float32"),
        "depth": ((18, 24), "float32"),
        "normals": ((18, 24, 3), "float32"),
        "labels": ((18, 24), "int32"),
        "points": ((18, 24, 3), "float32"),
        "lidar": [((rays,), "float32"), ((rays, 3), "float32"), ((rays,), "int32")],
    }
    alone = jax.eval_shape(lambda camera: observe(SCENE, camera, SENSORS), PINHOLE)
    rig = CameraRig.of([PINHOLE, PINHOLE])
    together = jax.eval_shape(lambda rig: observe(SCENE, rig, SENSORS), rig)
    for name, wanted in expected.items():
        wanted = wanted if isinstance(wanted, list) else [wanted]
        for leaf, both, (shape, kind) in zip(
            jax.tree.leaves(alone[name]), jax.tree.leaves(together[name]), wanted, strict=True
        ):
            assert (leaf.shape, leaf.dtype.name) == (shape, kind), name
            assert (both.shape, both.dtype.name) == ((2, *shape), kind), name


@pytest.mark.slow
def test_noise_can_be_randomized_in_one_program_for_each_picture():
    keys = jax.random.split(jax.random.key(5), 3)

    def measured(exposure, quadratic, deviation, key):
        asked = {
            "rgb": Color(sensors.ColorNoise(exposure=exposure, full_well=300.0)),
            "depth": Depth(sensors.DepthNoise(quadratic=quadratic)),
            "scan": Lidar(jnp.asarray(TABLE), deviation=deviation, height=32),
        }
        return observe(SCENE, PINHOLE, asked, key=key)

    given = jnp.array([0.2, 0.5, 1.0]), jnp.array([0.0, 0.02, 0.05]), jnp.array([0.0, 0.01, 0.1])
    together = jax.jit(jax.vmap(measured))(*given, keys)
    brightness = np.asarray(together["rgb"]).mean(axis=(1, 2, 3))
    assert (np.diff(brightness) > 0.05).all()  # a longer exposure is brighter
    plain = observe(SCENE, PINHOLE, {"depth": Depth(), "scan": SENSORS["lidar"]})
    depth = np.asarray(together["depth"])
    errors = [np.std((one - plain["depth"])[one > 0]) for one in depth]
    assert errors[0] < errors[1] < errors[2]
    ranges = np.asarray(together["scan"].ranges)
    still = ranges[0]
    spread = [np.nanstd(one - still) for one in ranges]
    assert spread[0] == 0
    assert_allclose(spread[1:], [0.01, 0.1], rtol=0.35)


def test_a_whole_drive_is_one_map_over_poses():
    rig = CameraRig.of([PINHOLE], ("front",))
    shifts = jnp.array([0.0, 0.1, 0.3])

    def at(shift):
        body = Similarity(jnp.eye(3), jnp.stack([0.0 * shift, 0.0 * shift, shift]))
        return observe(SCENE, rig.at(body), {"depth": Depth()})["depth"][0]

    drive = jax.jit(lambda shifts: jax.lax.map(at, shifts))(shifts)
    for shift, seen in zip(shifts, drive, strict=True):
        assert_allclose(seen, at(shift), atol=1e-4)
    # Depth is in the units of the scene: 0.3 nearer is 0.3 less, where the plane faces the camera.
    middle = np.asarray(drive)[:, 9, 12]
    assert middle[0] - middle[2] > 0.25


def test_exposure_and_the_gaussians_have_gradients_through_a_noisy_picture():
    def brightness(exposure, sh):
        noise = sensors.ColorNoise(exposure=exposure)
        scene = replace(PLANE, sh=sh)
        return observe(scene, PINHOLE, {"c": Color(noise)}, key=jax.random.key(0))["c"].mean()

    at = jnp.float32(0.5)
    slope, rise = jax.grad(brightness, argnums=(0, 1))(at, PLANE.sh)
    finite = (brightness(at + 0.01, PLANE.sh) - brightness(at - 0.01, PLANE.sh)) / 0.02
    assert_allclose(slope, finite, rtol=2e-2)
    assert np.isfinite(rise).all()
    assert np.abs(rise).max() > 0


def test_millimetres_hold_16_bits_and_0_where_nothing_is_measured():
    depth = jnp.array([0.0, math.nan, 1.2344, 65.535, 65.6, -1.0, math.inf])
    assert_array_equal(sensors.millimetres(depth), [0, 0, 1234, 65535, 0, 0, 0])


def test_labels_beyond_their_number_are_refused_also_inside_jit():
    rows = jnp.arange(len(PLANE), dtype=jnp.int32) % 3
    labels = Labels(rows, 2)
    for draw in (observe, jax.jit(lambda scene, camera, sensors: observe(scene, camera, {"l": labels}))):
        with pytest.raises(ValueError, match="labels up to 2, and count is 2"):
            draw(PLANE, PINHOLE, {"l": labels})


@pytest.mark.parametrize("length", [0.0, math.nan])
def test_rays_of_a_lidar_that_point_nowhere_are_refused(length):
    rays = np.array([[0.0, 0.0, 1.0], [length, 0.0, 0.0]], np.float32)
    for table in (rays, jnp.asarray(rays)):
        with pytest.raises(ValueError, match="1 of 2 directions of a LiDAR"):
            Lidar(table)


def test_a_body_with_a_scale_is_refused():
    rig = CameraRig.of([PINHOLE])
    with pytest.raises(ValueError, match="a body with the scale 2"):
        rig.at(Similarity.of(scale=2.0))


def test_cameras_of_different_kinds_are_no_rig():
    with pytest.raises(ValueError, match="differ in image size"):
        CameraRig.of([PINHOLE, FISHEYE])
    with pytest.raises(ValueError, match="without cameras"):
        CameraRig.of([])
    with pytest.raises(ValueError, match="has 1 names"):
        CameraRig.of([PINHOLE, PINHOLE], ["left"])
