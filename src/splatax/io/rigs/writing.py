"""Writes .glb files with a skeleton, a skin and clips."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from splatax.io.files import write_whole
from splatax.io.rigs.nodes import FRAME
from splatax.math.srgb import to_linear
from splatax.scene.body import Body, strongest
from splatax.scene.clips import Clip
from splatax.scene.skeleton import Skeleton

TYPES = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}  # NumPy's codes to glTF's component types
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
EMPTY: Mapping[str, Any] = MappingProxyType({})
FOLLOWS = {"skin": 0}  # of a node whose mesh follows the skeleton
VERTICES, INDICES = 34962, 34963  # glTF's buffer targets


class Glb:
    """A .glb file that is being put together: the arrays so far, and their accessors."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.parts: list[bytes] = []
        self.length = 0

    def add(
        self, rows: np.ndarray, *, target: int | None = None, normalized: bool = False, limits: bool = False
    ) -> int:
        """Appends an array and returns the index of its accessor.

        Args:
            rows: one row for each element, uint8, uint16, uint32 or float32.
            target: glTF's buffer target.
            normalized: whether integers stand for fractions of their maximum.
            limits: whether the accessor states the smallest and largest values.
        """
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": TYPES[rows.dtype.str[1:]],
            "count": len(rows),
            "type": KINDS[rows.shape[1]],
        }
        if normalized:
            accessor["normalized"] = True
        if limits and len(rows):
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": rows.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        contents = np.ascontiguousarray(rows).tobytes()
        contents += b"\0" * (-len(contents) % 4)
        self.parts.append(contents)
        self.length += len(contents)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def write(self, path: Path, gltf: dict[str, Any]) -> None:
        """Writes the file with this JSON, which gets the accessors and the buffer."""
        whole = {
            **gltf,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }
        text = json.dumps(whole, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self.length)
        head += struct.pack("<I4s", len(text), b"JSON") + text
        write_whole(path, b"".join([head, struct.pack("<I4s", self.length, b"BIN\0"), *self.parts]))


@dataclass(frozen=True)
class Mesh:
    """A mesh of a file.

    Attributes:
        attributes: those of the vertices, in glTF's frame, by name. A mesh that follows a skeleton is in the
            bound pose, with JOINTS_0 and WEIGHTS_0.
        primitive: other properties of the mesh's primitive.
        triangles: indices of vertices; None for a mesh of points.
    """

    attributes: Mapping[str, np.ndarray]
    primitive: Mapping[str, Any]
    triangles: Int[np.ndarray, "t 3"] | None = None


def write_skinned(
    path: Path,
    skeleton: Skeleton,
    clips: Mapping[str, Clip],
    meshes: Sequence[Mesh],
    nodes: Sequence[dict[str, Any]],
    comments: Sequence[str] = (),
    kept: Mapping[str, Any] = EMPTY,
) -> None:
    """Writes meshes, of which some follow a skeleton.

    Args:
        path: file to write.
        skeleton: the joints, which become nodes.
        clips: by name.
        meshes: those that nodes name.
        nodes: glTF's objects that place the meshes. Those with `FOLLOWS` follow the skeleton.
        comments: lines for the file's extras.
        kept: JSON values to keep with the scene, which other readers ignore.
    """
    glb = Glb()
    count = len(skeleton)
    primitives = []
    for mesh in meshes:
        primitive = {**mesh.primitive, "attributes": _accessors(glb, mesh.attributes)}
        if mesh.triangles is not None:
            primitive["indices"] = glb.add(mesh.triangles.reshape(-1, 1).astype("<u4"), target=INDICES)
        primitives.append(primitive)
    binds = np.asarray(skeleton.inverse_binds, np.float64) @ FRAME
    inverse = glb.add(binds.transpose(0, 2, 1).reshape(count, 16).astype("<f4"))
    animations = [_animation(glb, name, clip) for name, clip in clips.items() if clip.channels]
    joints = _nodes(skeleton)
    frame = _frame(skeleton, count + len(nodes))
    scene: dict[str, Any] = {"nodes": [*frame.tops, *range(count, count + len(nodes))]}
    if kept:
        scene["extras"] = {"splatax": dict(kept)}
    gltf: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "splatax", "extras": {"comments": list(comments)}},
        "scene": 0,
        "scenes": [scene],
        "nodes": [*joints, *nodes, *frame.nodes],
        "meshes": [{"primitives": [primitive]} for primitive in primitives],
        "skins": [{"joints": list(range(count)), "inverseBindMatrices": inverse}],
    }
    used = {name for thing in (*primitives, *nodes) for name in thing.get("extensions", ())}
    if used:
        gltf["extensionsUsed"] = sorted(used)
    if animations:
        gltf["animations"] = animations
    glb.write(path, gltf)


def _accessors(glb: Glb, attributes: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Appends the attributes of a mesh, and returns their accessors by name."""
    return {
        name: glb.add(
            rows,
            target=VERTICES,
            normalized=name == "COLOR_0" and rows.dtype.kind == "u",
            limits=name == "POSITION",
        )
        for name, rows in attributes.items()
    }


def joints_attributes(
    indices: Int[np.ndarray, "n k"], weights: Float[np.ndarray, "n k"], joints: int
) -> dict[str, np.ndarray]:
    """Returns the attributes JOINTS_0 and WEIGHTS_0, the four strongest joints of each vertex."""
    missing = max(4 - indices.shape[1], 0)
    indices, weights = (np.pad(rows, [(0, 0), (0, missing)]) for rows in (indices, weights))
    indices, weights = strongest(indices, weights)
    indices = np.where(weights > 0, indices, 0)  # as the validator asks
    return {
        "JOINTS_0": indices.astype("u1" if joints <= 256 else "<u2"),
        "WEIGHTS_0": weights.astype("<f4"),
    }


def save_body(path: str | Path, body: Body) -> None:
    """Writes a body as a .glb file that other programs open too, with the colours of its vertices."""
    surface = body.surface
    attributes = {
        "POSITION": (surface.vertices @ FRAME[:3, :3]).astype("<f4"),
        "COLOR_0": to_linear(surface.colors).astype("<f4"),  # glTF's are linear light
        **joints_attributes(surface.indices, surface.weights, len(body.skeleton)),
    }
    mesh = Mesh(attributes, {"mode": 4}, surface.triangles)
    node = {"name": "skinned", "mesh": 0, **FOLLOWS}
    write_skinned(Path(path), body.skeleton, body.clips, [mesh], [node])


class _Frame(NamedTuple):
    """The nodes above the joints, and the topmost nodes of the skeleton by their index."""

    nodes: list[dict[str, Any]]
    tops: list[int]


def _frame(skeleton: Skeleton, index: int) -> _Frame:
    """Returns the node that turns the frame of the joints to glTF's, if they need one.

    Args:
        skeleton: the joints, which are the first nodes of the file.
        index: index of the node.
    """
    tops = [joint for joint, parent in enumerate(skeleton.parents) if parent < 0]
    if np.allclose(np.asarray(skeleton.root), FRAME):
        return _Frame([], tops)
    matrix = FRAME @ np.asarray(skeleton.root, np.float64)
    return _Frame([{"name": "frame", "matrix": matrix.T.ravel().tolist(), "children": tops}], [index])


def _nodes(skeleton: Skeleton) -> list[dict[str, Any]]:
    rest = skeleton.rest
    nodes: list[dict[str, Any]] = []
    for joint, name in enumerate(skeleton.names):
        w, x, y, z = np.asarray(rest.quats[joint], np.float64) / np.linalg.norm(rest.quats[joint])
        node: dict[str, Any] = {
            "name": name,
            "translation": np.asarray(rest.translations[joint], np.float64).tolist(),
            "rotation": [x, y, z, w],
            "scale": np.asarray(rest.scales[joint], np.float64).tolist(),
        }
        if children := [i for i, parent in enumerate(skeleton.parents) if parent == joint]:
            node["children"] = children
        nodes.append(node)
    return nodes


def _animation(glb: Glb, name: str, clip: Clip) -> dict[str, Any]:
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for channel in clip.channels:
        values = channel.values[..., [1, 2, 3, 0]] if channel.path == "rotation" else channel.values
        channels.append({"sampler": len(samplers), "target": {"node": channel.joint, "path": channel.path}})
        samplers.append(
            {
                "input": glb.add(channel.times[:, None].astype("<f4"), limits=True),
                "output": glb.add(values.reshape(-1, values.shape[-1]).astype("<f4")),
                "interpolation": channel.interpolation,
            }
        )
    return {"name": name, "channels": channels, "samplers": samplers}
