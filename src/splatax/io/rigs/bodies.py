"""Bodies from .glb files: triangles that follow joints."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.errors import FormatError, shown
from splatax.io.formats import glb_scene
from splatax.io.formats.glb_scene import Glb
from splatax.io.formats.untrusted import structured
from splatax.io.rigs.following import check_following
from splatax.io.rigs.nodes import FRAME, Binding, Nodes, read_skeleton
from splatax.math.srgb import to_display
from splatax.scene.body import JOINTS, Body, Surface, strongest

TRIANGLES = 4  # glTF's mode of a primitive
PLAIN = 0.8  # display-referred grey of meshes without a colour


def read_body(path: str | Path) -> Body:
    """Reads a .glb file with a mesh and its skeleton.

    Raises:
        FormatError: if the file is missing or damaged, nothing in it can move, it has no triangles, or a skin
            or clip is not valid.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a .glb file with a mesh and its skeleton.")
    with structured(path, ".glb"):
        file = glb_scene.read(path)
        gltf = file.gltf
        found = [
            (number, primitive)
            for number, node in enumerate(gltf.get("nodes", ()))
            if "mesh" in node
            for primitive in gltf["meshes"][node["mesh"]]["primitives"]
            if primitive.get("mode", TRIANGLES) == TRIANGLES
        ]
        primitives = [primitive for _, primitive in found]
        glb_scene.check_repetition(file, primitives, "vertices")
        skeleton, clips, nodes, binding = read_skeleton(file)
        parts = [_part(file, number, primitive, nodes, binding) for number, primitive in found]
        if not parts:
            raise FormatError(f"{path}: no triangles. Give a .glb file with a mesh and its skeleton.")
        surface = _joined(parts)
    morphs = any("targets" in p for mesh in gltf["meshes"] for p in mesh["primitives"])
    notes = ("its morph targets are not used: the body follows its joints alone",) if morphs else ()
    return Body(skeleton, clips, surface, notes)


def _part(file: Glb, number: int, primitive: dict[str, Any], nodes: Nodes, binding: Binding) -> Surface:
    path, node, attributes = file.path, file.gltf["nodes"][number], primitive["attributes"]

    def read(name: str) -> np.ndarray:
        return glb_scene.accessor(file, attributes[name]).astype(np.float64)

    vertices = read("POSITION")
    count = len(vertices)
    if "indices" in primitive:
        corners = glb_scene.accessor(file, primitive["indices"])[:, 0].astype(np.int64)
    else:
        corners = np.arange(count)
    if len(corners) % 3 or (len(corners) and corners.max() >= count):
        raise FormatError(f"{path}: damaged: its triangles name vertices that are not there.")
    if "skin" in node:
        place, joints = binding.placed[node["skin"]], binding.joints[node["skin"]]
        sets = sorted(name for name in attributes if name.startswith("JOINTS_"))
        if not sets:
            raise FormatError(
                f"{path}: the mesh of {shown(str(node.get('name')))} has a skin but no JOINTS_0."
            )
        found = np.concatenate([read(name) for name in sets], axis=1)
        weights = np.concatenate([read(name.replace("JOINTS", "WEIGHTS")) for name in sets], axis=1)
        if len(found) != count or len(weights) != count:
            raise FormatError(f"{path}: damaged: not every vertex has joints. Get the file again.")
        found = check_following(path, found, weights, len(joints))
        indices, weights = strongest(joints[found], weights)
    else:
        own = nodes.places[number]
        place = binding.worlds[own]
        indices, weights = np.full((count, JOINTS), own), np.tile([1.0, 0, 0, 0], (count, 1))
    placed = FRAME @ place
    world = vertices @ placed[:3, :3].T + placed[:3, 3]
    colors = _colors(
        file.gltf, primitive, read("COLOR_0") if "COLOR_0" in attributes else np.ones((count, 3))
    )
    if len(colors) != count:
        raise FormatError(f"{path}: damaged: not every vertex has a colour. Get the file again.")
    return Surface(world, corners.reshape(-1, 3), indices, weights, colors)


def _colors(
    gltf: dict[str, Any], primitive: dict[str, Any], factors: Float[np.ndarray, "v _"]
) -> Float[np.ndarray, "v 3"]:
    """Returns display-referred colours: the material's base colour times those of the vertices, both linear.

    Args:
        gltf: the JSON chunk.
        primitive: the mesh.
        factors: COLOR_0, RGB or RGBA in linear light; ones for a mesh without.
    """
    base = np.ones(3)
    if "material" in primitive:
        material = gltf["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
        base = np.array(material.get("baseColorFactor", (1, 1, 1, 1)), np.float64)[:3]
    elif "COLOR_0" not in primitive["attributes"]:
        return np.full((len(factors), 3), PLAIN)
    return to_display(base * factors[:, :3])


def _joined(parts: list[Surface]) -> Surface:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(triangles),
        np.concatenate([part.indices for part in parts]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.colors for part in parts]),
    )
