"""`Twin`: a scene of parts that follows a simulation, seen by the cameras of its model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.rendering import BLACK, Renderer
from splatax.scene import Scene
from splatax.sensors import CameraRig, Sensor, observe
from splatax.sensors.protocol import Key
from splatax.twins.bridge import Frames, body_rows, camera_of, camera_poses, camera_row, frames_of

Size = tuple[int, int]


@dataclass(frozen=True)
class Twin:
    """A scene of parts that follows the bodies of a MuJoCo model, and what the model's cameras measure in it.

    Attributes:
        model: `mujoco.MjModel`.
        scene: parts named after bodies, in the coordinates of these bodies; see `attached`.
        rig: the cameras in the order of their names, at any pose.
        sensors: what each camera measures, by names of your choice.
        renderer: background, filter and backend.
    """

    model: Any
    scene: Scene
    rig: CameraRig
    sensors: Mapping[str, Sensor]
    renderer: Renderer = Renderer(BLACK)

    @classmethod
    def of(
        cls,
        model: Any,
        data: Any,
        scene: Scene,
        cameras: Sequence[str],
        size: Size,
        sensors: Mapping[str, Sensor],
    ) -> "Twin":
        """Returns the twin that some cameras of a model look at.

        Args:
            model: `mujoco.MjModel`.
            data: `mujoco.MjData`, after `mj_forward` or a step.
            scene: parts named after bodies, in the coordinates of these bodies.
            cameras: names of cameras of the model.
            size: width and height of their images, pixels.
            sensors: what each camera measures, by names of your choice.

        Raises:
            InputError: if a part is no body of the model, or there is no perspective camera of a name.
            ValueError: if no camera is named.
        """
        body_rows(model, scene.names)
        rig = CameraRig.of([camera_of(model, data, name, *size) for name in cameras], tuple(cameras))
        scene = jax.tree.map(jnp.asarray, scene)  # on the device once, not once a frame
        return cls(model, scene, rig, dict(sensors))

    def observe(self, data: Any, key: Key | None = None) -> dict[str, Any]:
        """Returns what the sensors measure now, as `splatax.sensors.observe` does with a rig.

        The program is compiled at the first call. Later calls transfer the poses of the bodies and cameras.

        Args:
            data: `mujoco.MjData`, after `mj_forward` or a step.
            key: random key of the noise; None for measurements without noise.

        Raises:
            InputError: if the data has no poses yet.
        """
        state = self._state(data)
        return _observed(self.scene, *state, self.rig, dict(self.sensors), self.renderer, key)

    def observe_all(self, data: Sequence[Any], key: Key | None = None) -> dict[str, Any]:
        """Returns what the sensors measure in several simulations of the model, drawn together by `vmap`.

        Each measurement has two leading axes: the simulation, and the camera.

        Args:
            data: one or more of `mujoco.MjData`, after `mj_forward` or a step.
            key: random key of the noise; None for measurements without noise.

        Raises:
            InputError: if one has no poses yet.
            ValueError: if there is none.
        """
        if not data:
            raise ValueError("no simulation to observe. Give at least one.")
        states = jax.tree.map(lambda *leaves: np.stack(leaves), *map(self._state, data))
        keys = None if key is None else jax.random.split(key, len(data))
        return _all_observed(self.scene, *states, self.rig, dict(self.sensors), self.renderer, keys)

    def _state(self, data: Any) -> tuple[Frames, Float[np.ndarray, "c 4 4"]]:
        """Returns the poses of bodies and of cameras."""
        rows = [camera_row(self.model, name) for name in self.rig.names]
        return frames_of(self.model, data, self.scene.names), camera_poses(data, rows)


def _measured(
    scene: Scene,
    frames: Frames,
    poses: Float[Array, "c 4 4"],
    rig: CameraRig,
    sensors: dict[str, Sensor],
    renderer: Renderer,
    key: Key | None,
) -> dict[str, Any]:
    placed = replace(rig, cameras=replace(rig.cameras, cam_from_world=poses))
    return observe(frames.place(scene), placed, sensors, key=key, renderer=renderer)


_observed = jax.jit(_measured)


@jax.jit
def _all_observed(scene, frames, poses, rig, sensors, renderer, keys):
    def one(frames: Frames, poses: Array, key: Key | None) -> dict[str, Any]:
        return _measured(scene, frames, poses, rig, sensors, renderer, key)

    return jax.vmap(one, in_axes=(0, 0, None if keys is None else 0))(frames, poses, keys)
