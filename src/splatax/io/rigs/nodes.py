"""The parts of a .glb file that move: nodes, skins and animations, and the meshes that they move.

glTF is left-up-forward, ours right-down-forward: half a turn around z, as for splats in a .glb file.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from splatax.errors import FormatError, shown
from splatax.io.formats import glb_scene
from splatax.io.formats.glb_scene import Glb
from splatax.scene.clips import Channel, Clip
from splatax.scene.skeleton import Pose, Skeleton

FRAME = np.diag([-1.0, -1.0, 1.0, 1.0])  # glTF's world to ours, and back
PATHS = {"translation": 3, "rotation": 4, "scale": 3}
INTERPOLATIONS = {"LINEAR": 1, "STEP": 1, "CUBICSPLINE": 3}  # rows for each time
LONGEST = 3600.0  # seconds of a clip; the times of a damaged file may be any numbers
AGREE = 1e-3  # relative difference up to which two skins bind a joint in the same place


@dataclass(frozen=True)
class Nodes:
    """The nodes that move something, parents first.

    Attributes:
        ids: index of each in the file.
        parents: index of each one's parent in this list; -1 without one.
        names: unique names.
        locals: transforms to the parent's frame.
    """

    ids: list[int]
    parents: list[int]
    names: list[str]
    locals: Float[np.ndarray, "j 4 4"]

    @property
    def worlds(self) -> Float[np.ndarray, "j 4 4"]:
        """Transforms to glTF's world, as the file stores the nodes."""
        worlds = np.zeros_like(self.locals)
        for joint, parent in enumerate(self.parents):
            worlds[joint] = (worlds[parent] if parent >= 0 else np.eye(4)) @ self.locals[joint]
        return worlds

    @cached_property
    def places(self) -> dict[int, int]:
        """Index in this list of each node of the file that is in it."""
        return {node: place for place, node in enumerate(self.ids)}


@dataclass
class Binding:
    """The pose in which the meshes were bound.

    Attributes:
        worlds: transforms of the nodes to glTF's world in that pose.
        placed: transform from the frame of each skin's meshes to glTF's world in that pose.
        joints: index of each skin's joints in the list of nodes.
    """

    worlds: Float[np.ndarray, "j 4 4"]
    placed: list[Float[np.ndarray, "4 4"]] = field(default_factory=list)
    joints: list[Int[np.ndarray, " _"]] = field(default_factory=list)


def read_skeleton(
    file: Glb,
) -> tuple[Skeleton, dict[str, Clip], Nodes, Binding]:
    """Returns the joints of a file, its clips by name, its nodes, and the pose in which meshes are bound.

    Nodes that carry a mesh without a skin are joints too: their meshes follow them rigidly.

    Raises:
        FormatError: if nothing in the file can move, or a skin or clip is not valid.
    """
    nodes = _moving_nodes(file)
    binding = _binding(file, nodes)
    rest = _pose(file.path, nodes)
    skeleton = Skeleton(
        rest,
        jnp.asarray(np.linalg.inv(binding.worlds) @ FRAME, jnp.float32),
        jnp.asarray(FRAME, jnp.float32),
        tuple(nodes.names),
        tuple(nodes.parents),
    )
    return skeleton, _clips(file, nodes), nodes, binding


def _moving_nodes(file: Glb) -> Nodes:
    """Returns joints, nodes with meshes, and all nodes above them."""
    gltf = file.gltf
    listed = gltf.get("nodes", [])
    parents = {child: i for i, node in enumerate(listed) for child in node.get("children", ())}
    wanted = {joint for skin in gltf.get("skins", ()) for joint in skin["joints"]}
    still = _meshes_of_splats(gltf)
    wanted |= {
        i
        for i, node in enumerate(listed)
        if "mesh" in node and "skin" not in node and node["mesh"] not in still
    }
    if not wanted:
        raise FormatError(
            f"{file.path}: nothing in it can move: it has neither a skin nor nodes with meshes. Export the "
            "body with its skeleton."
        )
    ids = _parents_first(file.path, wanted, parents)
    names = _unique((node, str(listed[node].get("name") or f"node {node}")) for node in ids)
    places = {node: place for place, node in enumerate(ids)}
    tops = [places.get(parents.get(node, -1), -1) for node in ids]
    return Nodes(ids, tops, names, np.stack([_local(listed[node]) for node in ids]))


def _parents_first(path: Path, wanted: Iterable[int], parents: Mapping[int, int]) -> list[int]:
    """Returns nodes and all nodes above them, each after its parent.

    Raises:
        FormatError: if a node is above itself.
    """
    found: dict[int, None] = {}
    for node in sorted(wanted):
        chain = {node: None}  # from the node up to one that is found
        above = parents.get(node)
        while above is not None and above not in found:
            if above in chain:
                raise FormatError(f"{path}: damaged: its nodes form a circle. Get the file again.")
            chain[above] = None
            above = parents.get(above)
        found.update(dict.fromkeys(reversed(chain)))
    return list(found)


def _meshes_of_splats(gltf: dict[str, Any]) -> set[int]:
    """Returns the meshes that are made of splats only. Without a skin, they are parts that stay."""
    return {
        number
        for number, mesh in enumerate(gltf.get("meshes", ()))
        if mesh["primitives"]
        and all(glb_scene.EXTENSION in primitive.get("extensions", {}) for primitive in mesh["primitives"])
    }


def _unique(named: Iterable[tuple[int, str]]) -> list[str]:
    """Returns names that occur once, by adding the number of the node, in brackets, to those that repeat."""
    names: dict[str, None] = {}
    for node, name in named:
        while name in names:
            name = f"{name} ({node})"
        names[name] = None
    return list(names)


def _local(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    local = np.eye(4)
    if "rotation" in node:
        local[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()
    local[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    local[:3, 3] = node.get("translation", (0, 0, 0))
    return local


def _pose(path: Path, nodes: Nodes) -> Pose:
    """Returns the transforms of the nodes in the file, apart into translation, rotation and scale."""
    linear = nodes.locals[:, :3, :3]
    scales = np.linalg.norm(linear, axis=1)
    turns = linear / np.where(scales > 0, scales, 1)[:, None, :]
    for name, turn in zip(nodes.names, turns, strict=True):
        if not np.allclose(turn.T @ turn, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
            raise FormatError(
                f"{path}: the node {shown(name)} is sheared, mirrored or scaled to zero. Apply its transform "
                "in the program that it comes from, and export it again."
            )
    quats = Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]
    return Pose(*(jnp.asarray(rows, jnp.float32) for rows in (nodes.locals[:, :3, 3], quats, scales)))


def _binding(file: Glb, nodes: Nodes) -> Binding:
    """Returns the pose in which meshes are bound, with the topmost joint where the file has it."""
    rest, known = nodes.worlds, dict[int, np.ndarray]()
    binding = Binding(np.zeros_like(rest))
    for number, skin in enumerate(file.gltf.get("skins", ())):
        joints = np.array([nodes.places[node] for node in skin["joints"]])
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            rows = glb_scene.accessor(file, skin["inverseBindMatrices"])
            inverse = rows.astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(inverse) < len(joints):
            raise FormatError(
                f"{file.path}: damaged: skin {number} has {len(joints)} joints, but {len(inverse)} inverse "
                "bind matrices. Export the body again."
            )
        first = next((k for k, joint in enumerate(joints) if joint in known), int(np.argmin(joints)))
        placed = known.get(joints[first], rest[joints[first]]) @ inverse[first]
        for joint, matrix in zip(joints.tolist(), inverse, strict=False):
            world = placed @ np.linalg.inv(matrix)
            other = known.setdefault(joint, world)
            if np.abs(other - world).max() > AGREE * np.abs(world).max():
                raise FormatError(
                    f"{file.path}: its skins bind the joint {shown(nodes.names[joint])} in different places. "
                    "Bind all meshes in the same pose, and export the body again."
                )
        binding.placed.append(placed)
        binding.joints.append(joints)
    for joint, parent in enumerate(nodes.parents):
        above = binding.worlds[parent] if parent >= 0 else np.eye(4)
        binding.worlds[joint] = known.get(joint, above @ nodes.locals[joint])
    return binding


def _clips(file: Glb, nodes: Nodes) -> dict[str, Clip]:
    clips: dict[str, Clip] = {}
    for number, animation in enumerate(file.gltf.get("animations", ())):
        name = str(animation.get("name") or f"clip {number}")
        name = name if name not in clips else f"{name} ({number})"
        channels = []
        for channel in animation["channels"]:
            target = channel["target"]
            if target["path"] not in PATHS or target.get("node") not in nodes.places:
                continue  # weights of morph targets, and nodes that move nothing
            sampler = animation["samplers"][channel["sampler"]]
            joint = nodes.places[target["node"]]
            channels.append(_channel(file, sampler, joint, target["path"], name))
        clips[name] = Clip(name, tuple(channels))
    return clips


def _channel(file: Glb, sampler: dict[str, Any], joint: int, prop: str, clip: str) -> Channel:
    interpolation = sampler.get("interpolation", "LINEAR")
    times = glb_scene.accessor(file, sampler["input"]).astype(np.float64)[:, 0]
    values = glb_scene.accessor(file, sampler["output"]).astype(np.float64)
    rows, width = INTERPOLATIONS.get(interpolation), PATHS[prop]
    wrong = rows is None or not len(times) or values.shape != (len(times) * rows, width)
    if wrong or (np.diff(times) <= 0).any() or not (np.isfinite(times).all() and np.isfinite(values).all()):
        raise FormatError(
            f"{file.path}: damaged: the clip {shown(clip)} moves a {prop} by {shown(str(interpolation))} "
            f"with {len(times)} times and {len(values)} values, or its times do not ascend. Export the "
            "clip again."
        )
    if max(-times[0], times[-1]) > LONGEST:
        raise FormatError(
            f"{file.path}: damaged: the clip {shown(clip)} has times from {times[0]:g} to {times[-1]:g} "
            "seconds. Clips of up to an hour are read. Export the clip again."
        )
    values = values.reshape(len(times), -1, width)
    if prop == "rotation":
        values = values[..., [3, 0, 1, 2]]
        if not values[:, values.shape[1] // 2].any(axis=1).all():
            raise FormatError(
                f"{file.path}: damaged: the clip {shown(clip)} has a rotation of zeros only. Export the clip "
                "again."
            )
    return Channel(joint, prop, times, values, interpolation)  # type: ignore[arg-type]
