"""Training through a skin, and poses recovered from photos."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatax as sx
from splatax.dataset import Dataset, PointCloud, View
from splatax.demo.rigged import camera_around, drawn_arm, posed_dataset
from splatax.metrics import to_8bit
from splatax.scene.binding import bind, covering
from splatax.scene.rigged import RiggedScene
from splatax.training.posing import Search, fit_pose, pose_search
from splatax.training.rigged import optimize_rig, recipe_for
from splatax.training.rigged_step import Learned

BODY = drawn_arm()
SIZE = 32


@pytest.fixture(autouse=True)
def promotion():
    """Optax raises floats to integer powers, which JAX refuses in strict mode."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def capture(times=(0.0, 0.5), views=3):
    poses = {str(time): BODY.clips["Wave"].pose(BODY.skeleton.rest, time) for time in times}
    photos = {
        f"{name}-{i}": (pose, camera_around(BODY, 2.1 * i, 0.2, SIZE))
        for name, pose in poses.items()
        for i in range(views)
    }
    return posed_dataset(BODY, photos), poses, {photo: photo.split("-")[0] for photo in photos}


def trained(learned=Learned(), steps=30, seed=0):
    dataset, poses, pose_of = capture()
    recipe = recipe_for(steps, 400, seed)
    recipe = replace(recipe, density=replace(recipe.density, every=5, start=0, until=25))
    losses = []
    for progress in optimize_rig(dataset, recipe, covering(BODY, 150), poses, pose_of, learned):
        losses.append(float(progress.loss))
    return progress, losses


def dense(rig, n):
    weights = np.zeros((n, len(rig.skeleton)))
    np.add.at(weights, (np.arange(n)[:, None], np.asarray(rig.indices)), np.asarray(rig.weights))
    return weights


@pytest.mark.slow
def test_the_scene_is_drawn_with_the_filter_and_in_the_order_that_it_was_trained_with():
    dataset, poses, pose_of = capture(views=1)
    recipe = recipe_for(1, 400)
    recipe = replace(recipe, drawing=replace(recipe.drawing, low_pass=sx.Antialiasing()))
    (last,) = optimize_rig(dataset, recipe, covering(BODY, 150), poses, pose_of)
    assert last.gaussians.low_pass == sx.Antialiasing()
    assert last.gaussians.order == recipe.drawing.order == "distance"


@pytest.mark.slow
def test_new_gaussians_follow_the_joints_of_their_parents_and_the_loss_falls():
    last, losses = trained()
    gaussians, rig = last.gaussians, last.rig
    assert len(gaussians) > 200  # more than at the start, by splitting
    assert rig.weights.shape == (len(gaussians), rig.indices.shape[1])
    nearest = dense(bind(gaussians, BODY), len(gaussians))
    assert np.median(np.abs(dense(rig, len(gaussians)) - nearest).max(axis=1)) < 0.1
    assert np.mean(losses[-6:]) < 0.7 * np.mean(losses[:6])
    np.testing.assert_allclose(np.sum(rig.weights, axis=1), 1, atol=1e-5)


def test_the_same_seed_gives_the_same_scene():
    first, second = (trained(steps=6)[0].gaussians for _ in range(2))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_poses_and_weights_move_only_on_request():
    _, poses, _ = capture()
    still, _ = trained(steps=6)
    moved, _ = trained(Learned(pose_rate=0.01, weight_rate=0.05), steps=6)
    for name, pose in poses.items():
        np.testing.assert_allclose(still.poses[name].quats, pose.quats, atol=1e-6)
        assert np.abs(moved.poses[name].quats - pose.quats).max() > 1e-3
    assert set(moved.poses) == set(poses)


def test_a_photo_without_a_pose_is_refused_by_name():
    dataset, poses, pose_of = capture()
    del pose_of["0.5-1"]
    with pytest.raises(sx.DatasetError, match=r"0\.5-1: no pose"):
        next(optimize_rig(dataset, recipe_for(5, 100), covering(BODY, 50), poses, pose_of))


@pytest.mark.slow
def test_joints_turned_by_ten_degrees_are_recovered_to_one_degree():
    gaussians, rig = covering(BODY, 600, opacity=0.9)
    u = np.asarray(gaussians.means)
    stripes = 1.5 * np.sin(u * [20, 7, 20])  # colours that tell a twist
    gaussians = replace(gaussians, sh=jnp.asarray(stripes[:, None], jnp.float32))
    scene = RiggedScene(gaussians, rig)
    truth = BODY.clips["Wave"].pose(BODY.skeleton.rest, 0.4)
    cameras = [camera_around(BODY, azimuth, 0.2, SIZE) for azimuth in (0.0, 2.1, 4.2)]
    photos = [to_8bit(np.asarray(sx.render(scene.posed(truth), camera).rgb)) for camera in cameras]
    views = [
        View(str(i), camera, lambda photo=photo: photo)
        for i, (camera, photo) in enumerate(zip(cameras, photos, strict=True))
    ]
    axes = np.random.default_rng(0).normal(size=(3, 3))
    axes *= np.radians(10) / np.linalg.norm(axes, axis=1, keepdims=True)
    start = BODY.skeleton.turned(dict(zip(BODY.skeleton.names, axes, strict=True)), truth)

    def errors(pose):
        turns = [Rotation.from_quat(np.asarray(p.quats)[:, [1, 2, 3, 0]]) for p in (pose, truth)]
        return np.degrees((turns[0].inv() * turns[1]).magnitude())

    np.testing.assert_allclose(errors(start), 10, atol=0.01)
    found = fit_pose(scene, views, start, Search(steps=200))
    assert errors(found).max() < 1
    none = Dataset((), (), PointCloud(np.zeros((0, 3)), np.zeros((0, 3))))
    with pytest.raises(sx.DatasetError, match="none"):
        fit_pose(scene, none.train, start)


@pytest.mark.slow
def test_stiff_joints_are_drawn_to_the_rest_pose_about_their_stiff_axes():
    gaussians, rig = covering(BODY, 20, opacity=1e-4)  # nothing is seen, so only the stiffness counts
    scene = RiggedScene(gaussians, rig, BODY.clips)
    camera = camera_around(BODY, 0.3, 0.2, SIZE)
    view = View("black.png", camera, lambda: np.zeros((SIZE, SIZE, 3), np.uint8))
    turn = np.array([0.2, -0.3, 0.1])
    start = BODY.skeleton.turned({"bone 2": turn})
    search = Search(steps=80, rate=0.02, joints=("bone 2",), stiffness=(0.0, 1.0, 2.0))
    (_, loss), *_, (last, _) = pose_search(scene, [view], start, search)
    np.testing.assert_allclose(loss, 1.0 * 0.3**2 + 2.0 * 0.1**2, rtol=1e-4)
    row = BODY.skeleton.index("bone 2")
    rest, found = (Rotation.from_quat(np.roll(p.quats[row], -1)) for p in (BODY.skeleton.rest, last))
    assert np.abs((rest.inv() * found).as_rotvec()[1:]).max() < 0.02
    np.testing.assert_allclose(last.quats[:row], start.quats[:row])  # other joints stay
    with pytest.raises(sx.InputError, match="at least 0"):
        fit_pose(scene, [view], start, Search(stiffness=(0.0, -1.0, 0.0)))


def test_a_search_for_a_pose_needs_steps_and_photos_of_the_size_of_their_cameras():
    scene, rest = RiggedScene(*covering(BODY, 20), BODY.clips), BODY.skeleton.rest
    dataset, *_ = capture(times=(0.0,), views=1)
    with pytest.raises(sx.InputError, match="Give at least 1"):
        fit_pose(scene, dataset.train, rest, Search(steps=0))
    (view,) = dataset.train
    wrong = replace(view, camera=view.camera.resized(SIZE // 2, SIZE // 2))
    with pytest.raises(sx.DatasetError, match="a photo of 32 x 32 pixels with a camera of 16 x 16"):
        fit_pose(scene, [wrong], rest)
