"""`TwinEnv`: an environment of gymnasium whose observations are what sensors measure in a twin.

Importing this module needs the packages of the extra "twins": `pip install '.[twins]'` in the checkout.
"""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np

from splatax.errors import InputError
from splatax.metrics import to_8bit
from splatax.packages import required_by
from splatax.rendering import render
from splatax.sensors import Color, Depth, Labels, Normals, Sensor
from splatax.twins.bridge import camera_of, frames_of
from splatax.twins.twin import Twin

with required_by("splatax.twins.environment", extra="twins"):
    import gymnasium
    import mujoco
    from gymnasium import spaces

STATE = ("qpos", "qvel")  # observations beside those of the sensors


@runtime_checkable
class Task(Protocol):
    """A task for an agent: how an episode starts, and the reward for its states."""

    def begin(self, model: Any, data: Any, rng: np.random.Generator) -> None:
        """Sets the state at the start of an episode. The data has just been reset."""
        ...

    def judge(self, model: Any, data: Any) -> tuple[float, bool]:
        """Returns the reward for the state after an action, and whether the episode ends in it."""
        ...


class TwinEnv(gymnasium.Env):
    """An environment of gymnasium over a MuJoCo simulation, with observations from a twin.

    An observation is a dictionary: the measurements of the twin's sensors, with a leading axis for the
    cameras, and "qpos" and "qvel", the positions and velocities of the joints. An action is the control of
    all actuators, which holds for `substeps` steps of the simulation. Limit the length of an episode with
    `gymnasium.wrappers.TimeLimit`.

    Attributes:
        twin: the scene, its cameras and sensors.
        task: starts and judges the episodes.
        data: `mujoco.MjData` of the running episode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  # as gymnasium declares it

    def __init__(self, twin: Twin, task: Task, *, substeps: int = 10, render_mode: str | None = None) -> None:
        """Makes the environment.

        Args:
            twin: the scene, its cameras and sensors; depth cameras with 0 as their invalid value.
            task: starts and judges the episodes.
            substeps: steps of the simulation for each action, at least 1.
            render_mode: "rgb_array" for `render`, or None.

        Raises:
            InputError: if a sensor has no space of observations, its name is taken, the model has no
                actuators, or there are no substeps.
        """
        if substeps < 1:
            raise InputError(f"{substeps} steps of the simulation for each action. Give at least 1.")
        if not twin.model.nu:
            raise InputError("the model has no actuators, so there is nothing to control. Add some.")
        if taken := [name for name in STATE if name in twin.sensors]:
            raise InputError(f"a sensor is called {taken[0]}, as the state of the joints. Rename it.")
        self.twin, self.task, self.substeps, self.render_mode = twin, task, substeps, render_mode
        self.data = mujoco.MjData(twin.model)
        mujoco.mj_forward(twin.model, self.data)
        self.action_space = _controls(twin.model)
        self.observation_space = spaces.Dict(self._spaces())
        self._key = jax.random.key(0)
        self._count = 0

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode, and returns its first observation and no information.

        Args:
            seed: of all randomness from now on; None to continue with the present random state.
            options: not used.
        """
        super().reset(seed=seed)
        mujoco.mj_resetData(self.twin.model, self.data)
        self.task.begin(self.twin.model, self.data, self.np_random)
        mujoco.mj_forward(self.twin.model, self.data)
        self._key, self._count = jax.random.key(int(self.np_random.integers(1 << 31))), 0
        return self._observed(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Applies an action, and returns observation, reward, whether the episode ended, False, and nothing.

        Args:
            action: control of each actuator; values out of range are clipped by MuJoCo.
        """
        self.data.ctrl[:] = action
        mujoco.mj_step(self.twin.model, self.data, nstep=self.substeps)
        mujoco.mj_forward(self.twin.model, self.data)  # poses of the new state
        self._count += 1
        reward, done = self.task.judge(self.twin.model, self.data)
        return self._observed(), float(reward), bool(done), False, {}

    def render(self) -> np.ndarray | None:
        """Returns the picture of the first camera, 8-bit RGB; None without a render mode."""
        if self.render_mode is None:
            return None
        twin, first = self.twin, self.twin.rig
        size = first.cameras.width, first.cameras.height
        camera = camera_of(twin.model, self.data, first.names[0], *size)
        scene = frames_of(twin.model, self.data, twin.scene.names).place(twin.scene)
        return to_8bit(np.asarray(render(scene, camera, outputs=("rgb",)).rgb))

    def _observed(self) -> dict[str, Any]:
        found = self.twin.observe(self.data, jax.random.fold_in(self._key, self._count))
        state = {"qpos": self.data.qpos.copy(), "qvel": self.data.qvel.copy()}
        return jax.tree.map(np.asarray, found) | state

    def _spaces(self) -> dict[str, spaces.Space]:
        twin = self.twin
        limits = {
            name: limits_of(name, sensor, len(twin.scene.parts)) for name, sensor in twin.sensors.items()
        }
        found = jax.eval_shape(lambda: twin.observe(self.data, jax.random.key(0)))
        measured = {
            name: spaces.Box(*limits[name], found[name].shape, found[name].dtype) for name in twin.sensors
        }
        free = {"qpos": twin.model.nq, "qvel": twin.model.nv}
        state = {name: spaces.Box(-np.inf, np.inf, (count,), np.float64) for name, count in free.items()}
        return measured | state


def limits_of(name: str, sensor: Sensor, parts: int) -> tuple[float, float]:
    """Returns the least and the largest value that a sensor measures.

    Args:
        name: of the sensor, for the message.
        sensor: the sensor.
        parts: number of parts of the scene.

    Raises:
        InputError: if its measurements are no images of numbers, such as those of a LiDAR, or may be NaN.
    """
    match sensor:
        case Color():
            return 0.0, 1.0
        case Normals():
            return -1.0, 1.0
        case Labels():
            return -1.0, (parts if sensor.rows is None else sensor.count) - 1.0
        case Depth(invalid=0):
            return (-np.inf if sensor.noise else 0.0), np.inf  # noise may move a depth below 0
    raise InputError(
        f"sensor {name} ({type(sensor).__name__}) has no space of observations: environments take Color, "
        "Depth with 0 where nothing is measured, Normals and Labels."
    )


def _controls(model: Any) -> spaces.Box:
    """Returns the space of the actuators' controls; those without a range are unlimited."""
    low, high = np.asarray(model.actuator_ctrlrange, np.float32).T
    limited = np.asarray(model.actuator_ctrllimited, bool)
    return spaces.Box(np.where(limited, low, -np.inf), np.where(limited, high, np.inf), dtype=np.float32)
