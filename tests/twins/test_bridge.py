"""The bridge to MuJoCo: parts are where the bodies of their names are, and cameras see what MuJoCo's see."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from splatax import twins
from splatax.demo.robot import ARM, drawn_twin
from splatax.sensors import Color, Depth, Labels
from splatax.transforms import Similarity
from splatax.twins.twin import _observed

mujoco = pytest.importorskip("mujoco")
BENT = (0.4, -0.6, 0.9, 0.5)
SENSORS = {"rgb": Color(), "depth": Depth(), "what": Labels()}


@pytest.fixture
def promotion():
    """Optax raises floats to integer powers, which JAX refuses in strict mode."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(ARM)


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    data.qpos[:] = BENT
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture(scope="module")
def scene(model):
    return drawn_twin(model, 400)


def test_a_part_is_where_the_body_of_its_name_is(model, data, scene):
    placed = twins.frames_of(model, data, scene.names).place(scene)
    for name in scene.names:
        body, point = data.body(name), np.array([0.03, -0.02, 0.1])
        expected = body.xmat.reshape(3, 3) @ point + body.xpos
        pose = placed[name].pose
        assert_allclose(
            pose.rotation @ jnp.asarray(point, jnp.float32) + pose.translation, expected, atol=1e-6
        )


def test_poses_are_copies_that_stay_when_the_simulation_goes_on(model, data, scene):
    frames = twins.frames_of(model, data, scene.names)
    before = frames.translations.copy()
    data.qpos[:] = 0
    mujoco.mj_forward(model, data)
    assert_array_equal(frames.translations, before)


def test_a_camera_of_the_model_projects_a_point_to_the_pixel_where_mujoco_has_it(model, data):
    camera = twins.camera_of(model, data, "front", 64, 48)
    at, turn = data.camera("front").xpos, data.camera("front").xmat.reshape(3, 3)
    local = (np.array([0.05, 0.1, 0.3]) - at) @ turn  # x right, y up, towards -z
    half = np.tan(np.radians(model.cam_fovy[0]) / 2)
    expected = 32 + 24 * local[0] / -local[2] / half, 24 - 24 * local[1] / -local[2] / half
    pose = np.asarray(camera.cam_from_world)
    point = pose[:3, :3] @ np.array([0.05, 0.1, 0.3], np.float32) + pose[:3, 3]
    assert_allclose(camera.to_pixel(jnp.asarray(point, jnp.float32)), expected, atol=1e-3)


@pytest.mark.slow
def test_parts_of_a_scan_move_with_the_bodies_that_they_were_photographed_on(model, data, scene):
    """A scan in units of 0.5 m, in a frame of its own, taken while the arm was bent."""
    frames = twins.frames_of(model, data, scene.names)
    world_from_scan = Similarity.of(degrees=(10.0, 20.0, 30.0), scale=0.5, move=(0.1, 0.2, 0.3))
    back = world_from_scan.inverse()
    scan = sx.Scene(
        {name: sx.Part(back.transform(p.in_world())) for name, p in frames.place(scene).parts.items()}
    )
    twin = twins.attached(scan, frames, world_from_scan)
    for name in scene.names:
        assert_allclose(twin[name].gaussians.means, scene[name].gaussians.means, atol=2e-6)
        assert_allclose(twin[name].gaussians.covariances, scene[name].gaussians.covariances, atol=1e-8)
        assert_allclose(twin[name].pose.translation, data.body(name).xpos, atol=1e-6)


@pytest.mark.slow
def test_a_twin_measures_what_observe_measures_in_the_posed_scene_and_compiles_once(model, data, scene):
    twin = twins.Twin.of(model, data, scene, ["front"], (32, 24), SENSORS)
    found = twin.observe(data)
    camera = twins.camera_of(model, data, "front", 32, 24)
    posed = twins.frames_of(model, data, scene.names).place(scene)
    alone = sx.sensors.observe(posed, camera, SENSORS)
    for name in SENSORS:
        assert_allclose(found[name][0], alone[name], atol=2e-5)
    assert set(np.unique(found["what"])) >= {0, 1, 3, 4}
    data.qpos[:] = 0.1
    mujoco.mj_forward(model, data)
    programs = _observed._cache_size()
    twin.observe(data)
    assert _observed._cache_size() == programs


def test_several_simulations_are_measured_together_as_each_by_itself(model, data, scene):
    twin = twins.Twin.of(model, data, scene, ["front"], (32, 24), {"depth": Depth()})
    other = copy.copy(data)
    other.qpos[:] = 0
    mujoco.mj_forward(model, other)
    together = twin.observe_all([data, other])["depth"]
    for both, each in zip(together, (data, other), strict=True):
        assert_allclose(both, twin.observe(each)["depth"], atol=1e-5)
    assert np.abs(together[0] - together[1]).max() > 0.1


def test_what_does_not_fit_is_refused_with_what_does(model, data, scene):
    with pytest.raises(sx.InputError, match=r"no body is called lid. The bodies are world, base"):
        twins.frames_of(model, data, ["lid"])
    with pytest.raises(sx.InputError, match=r"no camera is called back. The cameras are front"):
        twins.camera_of(model, data, "back", 8, 8)
    with pytest.raises(sx.InputError, match=r"Call mujoco.mj_forward"):
        twins.frames_of(model, mujoco.MjData(model), scene.names)
    frames = twins.frames_of(model, data, ["base"])
    with pytest.raises(sx.InputError, match="no pose of a body for the part world"):
        twins.attached(scene, frames)


@pytest.mark.slow
def test_a_small_part_of_a_coarse_twin_is_not_turned_away_from_its_pose(model, data, promotion):
    """The hand is 5 pixels wide, and the search begins 5 cm and 12 degrees beside its pose."""
    data.qpos[:] = 0.3, 0.35, -0.5, 0.4
    mujoco.mj_forward(model, data)
    coarse, fine = (
        twins.frames_of(model, data, (whole := drawn_twin(model, count)).names).place(whole)
        for count in (800, 5000)
    )
    camera = twins.camera_of(model, data, "front", 64, 64)
    seen = sx.sensors.observe(fine, camera, {"rgb": Color(), "depth": Depth()})
    truth, rng = coarse["hand"].pose, np.random.default_rng(2)
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    middle = np.median(np.asarray(coarse["hand"].gaussians.means), axis=0)
    turn = np.asarray(Similarity.from_twist(jnp.asarray([*np.radians(12) * axis, 0, 0, 0])).rotation)
    rotation = turn @ np.asarray(truth.rotation)
    center = np.asarray(truth.rotation) @ middle + np.asarray(truth.translation)
    wrong = Similarity(rotation, center + 0.05 * way - rotation @ middle)
    frame = twins.RgbdFrame(camera, seen["rgb"], seen["depth"])
    found = twins.located(coarse.posed({"hand": wrong}), "hand", frame, twins.LocationSearch(steps=120))
    cosine = (np.trace(np.asarray(found.rotation).T @ np.asarray(truth.rotation)) - 1) / 2
    assert np.degrees(np.arccos(min(cosine, 1))) < 12  # 22 if it is turned from the first step


@pytest.mark.slow
def test_the_pose_of_a_part_is_found_in_a_frame_of_colour_and_depth(model, data, promotion):
    scene = twins.frames_of(model, data, (whole := drawn_twin(model, 800)).names).place(whole)
    camera = twins.camera_of(model, data, "front", 48, 48)
    seen = sx.sensors.observe(scene, camera, {"rgb": Color(), "depth": Depth()})
    wrong = Similarity.of(degrees=(0.0, 0.0, 8.0)).after(scene["fore"].pose)
    wrong = Similarity(wrong.rotation, wrong.translation + jnp.array([0.01, 0.0, 0.02]), wrong.scale)
    frame = twins.RgbdFrame(camera, seen["rgb"], seen["depth"])
    found = twins.located(scene.posed({"fore": wrong}), "fore", frame, twins.LocationSearch(steps=120))
    truth = scene["fore"].pose
    cosine = (np.trace(np.asarray(found.rotation).T @ np.asarray(truth.rotation)) - 1) / 2
    assert np.degrees(np.arccos(min(cosine, 1))) < 1
    middle = np.array([0, 0, 0.135], np.float32)
    apart = (found.rotation - truth.rotation) @ middle + found.translation - truth.translation
    assert np.linalg.norm(apart) < 0.003
    with pytest.raises(sx.InputError, match="images of the camera's size"):
        twins.located(scene, "fore", twins.RgbdFrame(camera, seen["rgb"][:4], seen["depth"][:4]))
    with pytest.raises(sx.InputError, match="Give at least 1"):
        twins.located(scene, "fore", frame, twins.LocationSearch(steps=0))
    with pytest.raises(sx.InputError, match="Give a number from 0 to 1"):
        twins.located(scene, "fore", frame, twins.LocationSearch(shifting=60.0))
