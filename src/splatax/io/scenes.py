"""Scenes of parts as .glb files, whose nodes keep names, places and visibility.

`splatax.load` reads such a file as one set of Gaussians, and `load_scene` as parts.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians, broken
from splatax.io.formats import glb
from splatax.io.formats.glb_scene import VISIBILITY
from splatax.io.formats.marks import mark, marked
from splatax.io.formats.untrusted import structured
from splatax.scene import Part, Scene
from splatax.transforms import Similarity, half_turn

SIGNS = np.array([-1.0, -1.0, 1.0])  # half a turn about z, between our axes and glTF's


def load_scene(path: str | Path) -> Scene:
    """Reads a .glb file with the splats of each of its nodes as a part.

    Poses are relative to the scene, so the tree of nodes becomes a list. A node without a name is called
    "part", and names that occur twice get a number. A part is hidden if its node, or one above it, has
    `KHR_node_visibility`. Nodes that share a mesh share their Gaussians.

    Raises:
        FormatError: if the file is missing or damaged, is no .glb file, or has no splats.
    """
    path = Path(path)
    _check_suffix(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a .glb file with splats.")
    with structured(path, path.suffix):
        found = glb.placed(path)
        comments = glb.comments(path)
    turned: dict[int, Gaussians] = {}
    parts: dict[str, Part] = {}
    for at, gaussians in found:
        if id(gaussians) not in turned:
            turned[id(gaussians)] = marked(half_turn(gaussians, axis=2), comments)
        name = _unused(at.name or "part", parts)
        parts[name] = Part(turned[id(gaussians)], _half_turned(at.place), at.visible)
    return Scene(parts)


def save_scene(path: str | Path, scene: Scene, *, comments: tuple[str, ...] = ()) -> int:
    """Writes a .glb file with a node for each part, hidden ones too.

    Parts that share their Gaussians share a mesh in the file. Maps of colours are applied to the splats,
    since glTF has none. Empty slots and broken Gaussians are left out.

    Args:
        path: path of the file, which ends in .glb.
        scene: the scene.
        comments: lines to keep with the scene, beside the one that names its filter.

    Returns:
        The number of Gaussians in the file, counted once for each mesh.

    Raises:
        FormatError: if the file is no .glb file or cannot hold the scene: its parts were trained with
            different low-pass filters, or have SH above degree 3.
    """
    path = Path(path)
    _check_suffix(path)
    filters = {part.gaussians.low_pass for part in scene.parts.values()}
    if len(filters) > 1:
        raise FormatError(
            f"{path}: a file names one low-pass filter, and the parts were trained with different ones. "
            "Train them alike."
        )
    meshes: dict[tuple[int, int], int] = {}
    written: list[Gaussians] = []
    nodes: list[dict[str, Any]] = []
    for name, part in scene.parts.items():
        if part.gaussians.sh_degree > glb.MAX_SH_DEGREE:
            raise FormatError(
                f"{path}: .glb holds SH up to degree {glb.MAX_SH_DEGREE}, and part {name!r} has degree "
                f"{part.gaussians.sh_degree}. Reduce it (splatax.editing.reduce_degree)."
            )
        shared = (id(part.gaussians), id(part.color))
        if shared not in meshes:
            meshes[shared] = len(written)
            colored = part.gaussians if part.color is None else part.color.transform(part.gaussians)
            written.append(_sound(colored))
        nodes.append(_node(name, part, meshes[shared]))
    lines = (mark(filters.pop()), *comments)
    glb.write(path, written, nodes, lines)
    return sum(map(len, written))


def _node(name: str, part: Part, mesh: int) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    pose = _half_turned(part.pose)
    node: dict[str, Any] = {
        "name": name,
        "mesh": mesh,
        "rotation": Rotation.from_matrix(np.asarray(pose.rotation)).as_quat().tolist(),
        "translation": np.asarray(pose.translation, np.float64).tolist(),
        "scale": [float(pose.scale)] * 3,
    }
    if part.visible <= 0:
        node["extensions"] = {VISIBILITY: {"visible": False}}
    return node


def _half_turned(pose: Similarity) -> Similarity:
    """Returns a pose between our axes and glTF's; it undoes itself."""
    rotation, translation = np.asarray(pose.rotation), np.asarray(pose.translation)
    return Similarity(SIGNS[:, None] * rotation * SIGNS[None], SIGNS * translation, float(pose.scale))


def _sound(gaussians: Gaussians) -> Gaussians:
    keep = ~broken(gaussians) & ~np.isneginf(np.asarray(gaussians.opacity_logits))
    return gaussians if keep.all() else jax.tree.map(lambda leaf: leaf[keep], gaussians)


def _unused(name: str, taken: dict[str, Part]) -> str:
    number, found = 2, name
    while found in taken:
        found, number = f"{name} {number}", number + 1
    return found


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() != ".glb":
        raise FormatError(f"{path}: scenes of parts are kept in .glb files. Give the file such a name.")
