"""The environment of gymnasium over a twin."""

import importlib
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from splatax import twins
from splatax.demo.robot import ARM, drawn_twin
from splatax.packages import MissingPackageError
from splatax.sensors import Color, ColorNoise, Depth, Labels, Lidar

mujoco = pytest.importorskip("mujoco")
gymnasium = pytest.importorskip("gymnasium")
environment = importlib.import_module("splatax.twins.environment")


class Reach:
    """Reward for a hand near a place."""

    def begin(self, model, data, rng):
        data.qpos[:] = rng.uniform(-0.2, 0.2, model.nq)

    def judge(self, model, data):
        apart = float(np.linalg.norm(data.body("hand").xpos - [0.3, 0.0, 0.5]))
        return -apart, apart < 0.02


def made(sensors, **settings):
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    twin = twins.Twin.of(model, data, drawn_twin(model, 200), ["front"], (24, 16), sensors)
    return environment.TwinEnv(twin, Reach(), **settings)


@pytest.fixture(scope="module")
def env():
    sensors = {"rgb": Color(ColorNoise()), "depth": Depth(), "what": Labels()}
    return made(sensors, render_mode="rgb_array")


def test_it_keeps_the_contract_of_gymnasium(env):
    from gymnasium.utils.env_checker import check_env

    check_env(env, skip_render_check=True)


def test_observations_have_the_shapes_and_kinds_of_their_spaces(env):
    seen, _ = env.reset(seed=1)
    kinds = {name: (value.shape, value.dtype.name) for name, value in seen.items()}
    assert kinds == {
        "rgb": ((1, 16, 24, 3), "float32"),
        "depth": ((1, 16, 24), "float32"),
        "what": ((1, 16, 24), "int32"),
        "qpos": ((4,), "float64"),
        "qvel": ((4,), "float64"),
    }
    assert 0.1 < np.median(seen["depth"][seen["depth"] > 0]) < 10  # metres


def test_a_seed_repeats_an_episode_with_its_noise(env):
    def episode():
        first, _ = env.reset(seed=3)
        second, *_ = env.step(np.full(4, 0.3, np.float32))
        return first, second

    for once, again in zip(episode(), episode(), strict=True):
        for name in once:
            assert_array_equal(once[name], again[name])


def test_environments_in_a_vector_have_seeds_and_noise_of_their_own(env):
    fixed = {"rgb": Color(ColorNoise()), "depth": Depth()}
    together = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.wrappers.TimeLimit(made(fixed), 2)] * 2,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    alone = made(fixed)
    expected = [alone.reset(seed=seed)[0] for seed in (7, 8)]
    seen, _ = together.reset(seed=[7, 8])
    assert together.observation_space.contains(seen)
    for i, own in enumerate(expected):
        for name, value in own.items():
            assert_allclose(seen[name][i], value, atol=1e-5)
    assert np.abs(seen["rgb"][0] - seen["rgb"][1]).max() > 0.01
    action = np.zeros((2, 4), np.float32)
    _, rewards, ended, truncated, _ = together.step(action)
    assert rewards.shape == (2,)
    assert not ended.any()
    assert not truncated.any()
    again, *_, truncated, _ = together.step(action)
    assert truncated.all()
    assert np.isfinite(again["depth"]).all()
    together.close()


def test_an_action_moves_the_joints_and_the_observed_picture_follows(env):
    before, _ = env.reset(seed=0)
    for _ in range(20):
        after, reward, _, truncated, _ = env.step(np.array([1.0, 0, 0, 0], np.float32))
    assert after["qpos"][0] > before["qpos"][0] + 0.2
    assert np.abs(after["depth"] - before["depth"]).max() > 0.05
    hand = env.unwrapped.data.body("hand").xpos
    assert_allclose(-reward, np.linalg.norm(hand - [0.3, 0.0, 0.5]))
    assert not truncated
    picture = env.render()
    assert picture.shape == (16, 24, 3)
    assert_allclose(picture / 255, after["rgb"][0], atol=0.15)  # the noise of the camera


def test_sensors_without_a_space_and_models_without_actuators_are_refused():
    with pytest.raises(sx.InputError, match=r"sensor scan .Lidar. has no space"):
        made({"scan": Lidar(np.eye(3, dtype=np.float32))})
    with pytest.raises(sx.InputError, match="0 where nothing is measured"):
        made({"depth": Depth(invalid=float("nan"))})
    with pytest.raises(sx.InputError, match="Give at least 1"):
        made({"depth": Depth()}, substeps=0)
    with pytest.raises(sx.InputError, match="called qpos"):
        made({"qpos": Depth()})


def test_a_missing_package_is_named_with_the_way_to_install_it(monkeypatch):
    monkeypatch.delitem(sys.modules, "splatax.twins.environment")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(
        MissingPackageError, match=r"gymnasium, which is not installed: pip install '.\[twins\]'"
    ):
        importlib.import_module("splatax.twins.environment")
