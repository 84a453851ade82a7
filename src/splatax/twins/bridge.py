"""The bridge to MuJoCo: parts follow bodies of the same name, and cameras of the model see them.

The functions read arrays of the model and the data that they are given, so nothing here imports MuJoCo.
MuJoCo's world is the world of the scene, in metres, with z up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.errors import InputError, shown
from splatax.math import quaternions
from splatax.pytrees import pytree
from splatax.scene import Part, Scene
from splatax.transforms import Similarity

IDENTITY = Similarity(np.eye(3), np.zeros(3))
TO_OPENGL = np.diag([1.0, -1.0, -1.0])  # axes of a camera: y down, z forward -> y up, z back, as in MuJoCo


@pytree
@dataclass(frozen=True)
class Frames:
    """Poses of bodies in the world, as one value that passes through `jit` and `vmap`.

    Attributes:
        quats: rotations (w, x, y, z).
        translations: metres.
        names: names of the bodies, in their order (static).
    """

    quats: Float[Array, "b 4"] | Float[np.ndarray, "b 4"]
    translations: Float[Array, "b 3"] | Float[np.ndarray, "b 3"]
    names: tuple[str, ...] = field(metadata={"static": True})

    @property
    def poses(self) -> dict[str, Similarity]:
        """Transforms from the bodies to the world by name, for `Scene.posed`. Traceable."""
        quats, places = jnp.asarray(self.quats), jnp.asarray(self.translations)
        turns = jax.vmap(quaternions.to_rotation)(quats)
        return {name: Similarity(turns[i], places[i]) for i, name in enumerate(self.names)}

    def place(self, scene: Scene) -> Scene:
        """Returns the scene with the parts at the poses of the bodies of their names. Traceable."""
        return scene.posed(self.poses)


def frames_of(model: Any, data: Any, names: Sequence[str]) -> Frames:
    """Returns the poses that bodies have now: a copy of their `xpos` and `xquat`.

    Args:
        model: `mujoco.MjModel`.
        data: `mujoco.MjData`, after `mj_forward` or a step.
        names: names of bodies; "world" is the body that does not move.

    Raises:
        InputError: if there is no body of a name, or the data has no poses yet.
    """
    rows = body_rows(model, names)
    quats = np.asarray(data.xquat, np.float32)[rows]
    if not np.any(quats, axis=1).all():
        raise InputError("the bodies have no poses yet. Call mujoco.mj_forward(model, data) first.")
    return Frames(quats, np.asarray(data.xpos, np.float32)[rows], tuple(names))


def body_rows(model: Any, names: Sequence[str]) -> list[int]:
    """Returns the indices of bodies.

    Raises:
        InputError: if there is no body of a name.
    """
    rows = {model.body(i).name: i for i in range(model.nbody)}
    for name in names:
        if name not in rows:
            known = ", ".join(filter(None, rows))
            raise InputError(
                f"no body is called {shown(name)}. The bodies are {shown(known, 300)}. Parts that do not "
                "move belong to the body world."
            )
    return [rows[name] for name in names]


def attached(scene: Scene, frames: Frames, world_from_scene: Similarity = IDENTITY) -> Scene:
    """Returns a scene whose parts are kept in the coordinates of the bodies of their names.

    It looks as before, moved by `world_from_scene`. Afterwards `frames_of(...).place(scene)` moves its parts.

    Args:
        scene: the parts as they were photographed.
        frames: poses of the bodies when the photos were taken.
        world_from_scene: from the coordinates of the scene to the world of the simulation, for example
            to metres.

    Raises:
        InputError: if there is no body for a part.
    """
    poses = frames.poses
    if missing := [name for name in scene.names if name not in poses]:
        raise InputError(
            f"no pose of a body for the part {shown(missing[0])}. Name parts after bodies, and those that do "
            "not move world."
        )

    def moved(name: str, part: Part) -> Part:
        local = _on_host(poses[name]).inverse().after(world_from_scene).after(_on_host(part.pose))
        return Part(local.transform(part.gaussians), poses[name], part.visible, part.color)

    return Scene({name: moved(name, part) for name, part in scene.parts.items()})


def _on_host(pose: Similarity) -> Similarity:
    """Returns a pose in double precision."""
    rotation, translation = (np.asarray(leaf, np.float64) for leaf in (pose.rotation, pose.translation))
    return Similarity(rotation, translation, float(pose.scale))


def camera_of(model: Any, data: Any, name: str, width: int, height: int) -> Camera:
    """Returns a camera of the model as it stands now.

    Args:
        model: `mujoco.MjModel`.
        data: `mujoco.MjData`, after `mj_forward` or a step.
        name: name of the camera.
        width: of the image, pixels.
        height: of the image, pixels.

    Raises:
        InputError: if there is no camera of this name, or it is no perspective camera given by its field of
            view.
    """
    index = camera_row(model, name)
    if np.any(model.cam_sensorsize[index]):
        raise InputError(
            f"camera {shown(name)} is given by the size of its sensor. Give its field of view (fovy) instead."
        )
    if not 0 < (fov := float(model.cam_fovy[index])) < 180:
        raise InputError(f"camera {shown(name)} has a field of view of {fov:g} degrees; 0 to 180 are needed.")
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    pose = camera_poses(data, [index])[0]
    return Camera.simple_pinhole(focal, jnp.asarray(pose), width, height)


def camera_row(model: Any, name: str) -> int:
    """Returns the index of a camera.

    Raises:
        InputError: if there is no camera of this name.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        known = ", ".join(filter(None, names)) or "none"
        raise InputError(f"no camera is called {shown(name)}. The cameras are {shown(known, 300)}.")
    return names.index(name)


def camera_poses(data: Any, rows: Sequence[int]) -> Float[np.ndarray, "c 4 4"]:
    """Returns `cam_from_world` of cameras of the model as they stand now, in float32."""
    rows = list(rows)
    turns = np.asarray(data.cam_xmat, np.float64)[rows].reshape(-1, 3, 3) @ TO_OPENGL
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = turns.transpose(0, 2, 1)
    poses[:, :3, 3] = -np.einsum("cji,cj->ci", turns, np.asarray(data.cam_xpos, np.float64)[rows])
    return poses.astype(np.float32)
