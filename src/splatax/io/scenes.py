"""Scenes of parts as .glb files, whose nodes keep names, places and visibility.

`splatax.load` reads such a file as one set of Gaussians, `load_scene` as parts, and `load_variants` with its
variants.
"""

from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from splatax.errors import FormatError
from splatax.gaussians import Gaussians, broken, rows_of
from splatax.io.formats import glb, glb_scene
from splatax.io.formats.glb_scene import ORIGINAL, VISIBILITY, Glb, Placed
from splatax.io.formats.marks import is_mark, marked, marks_of
from splatax.io.formats.untrusted import structured
from splatax.io.variants import listed, map_of, numbers_of, variants_of
from splatax.order import common
from splatax.scene import Part, Scene, Variants, chosen
from splatax.scene.variants import check_variants
from splatax.transforms import Similarity, half_turn

NO_VARIANTS: Variants = MappingProxyType({})
SIGNS = np.array([-1.0, -1.0, 1.0])  # half a turn about z, between our axes and glTF's


def load_scene(path: str | Path) -> Scene:
    """Reads a .glb file with the splats of each of its nodes as a part.

    A file with variants is read with the first option of each; `load_variants` reads all of them.

    Poses are relative to the scene, so the tree of nodes becomes a list. A node without a name is called
    "part", and names that occur twice get a number. A part is hidden if its node, or one above it, has
    `KHR_node_visibility`. Nodes that share a mesh share their Gaussians.

    Raises:
        FormatError: if the file is missing or damaged, is no .glb file, or has no splats.
    """
    with opened(path) as file:
        return scene_in(file)


def load_variants(path: str | Path) -> tuple[Scene, Variants]:
    """Reads a .glb file with its variants, as `save_scene` wrote them.

    Returns:
        The scene in which all parts are as without variants, for `splatax.scene.chosen`, and the variants;
        there are none in a file that other programs wrote.

    Raises:
        FormatError: see `load_scene`; or if the variants do not fit the parts.
    """
    with opened(path) as file:
        return variants_in(file)


@contextmanager
def opened(path: str | Path) -> Iterator[Glb]:
    """Reads a .glb file, and turns errors about it inside into a `FormatError`.

    Raises:
        FormatError: if the file is missing or damaged, or is no .glb file.
    """
    path = Path(path)
    _check_suffix(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a .glb file with splats.")
    with structured(path, path.suffix):
        yield glb_scene.read(path)


def scene_in(file: Glb) -> Scene:
    """Returns the parts of a file; see `load_scene`."""
    return Scene({name: part for name, (part, _) in _parts(file).items()})


def variants_in(file: Glb) -> tuple[Scene, Variants]:
    """Returns the parts of a file as without variants, and the variants; see `load_variants`."""
    scene = Scene({name: _alone(part, extras) for name, (part, extras) in _parts(file).items()})
    variants = variants_of(glb.extras_in(file).get("variants", ()))
    check_variants(scene, variants)
    return scene, variants


def _parts(file: Glb) -> dict[str, tuple[Part, dict[str, Any]]]:
    """Returns the parts of a file as its nodes show them, each with what was noted at its node."""
    comments = glb.comments_in(file)
    turned: dict[int, Gaussians] = {}
    parts: dict[str, tuple[Part, dict[str, Any]]] = {}
    found = glb.placed(file, ORIGINAL)
    for name, (at, gaussians) in zip(names_of([at for at, _ in found]), found, strict=True):
        if id(gaussians) not in turned:
            turned[id(gaussians)] = marked(half_turn(gaussians, axis=2), comments)
        # Other programs may have dropped the original harmonics: the map is then part of the colours.
        original = any(attribute.startswith(ORIGINAL) for attribute in at.primitive["attributes"])
        color = map_of(at.extras["color"]) if original and "color" in at.extras else None
        parts[name] = Part(turned[id(gaussians)], half_turned(at.place), at.visible, color), at.extras
    return parts


def names_of(placed: Sequence[Placed]) -> list[str]:
    """Returns the names of the parts that nodes become: "part" without a name, and a number if it repeats."""
    names: list[str] = []
    for at in placed:
        names.append(_unused(at.name or "part", names))
    return names


def _alone(part: Part, extras: Mapping[str, Any]) -> Part:
    """Returns a part as it is without variants."""
    if (alone := extras.get("alone")) is None:
        return part
    color = None if alone["color"] is None else map_of(alone["color"])
    return replace(part, visible=bool(alone["visible"]), color=color)


def save_scene(
    path: str | Path, scene: Scene, *, variants: Variants = NO_VARIANTS, comments: tuple[str, ...] = ()
) -> int:
    """Writes a .glb file with a node for each part, hidden ones too.

    Parts that share their Gaussians and colours share a mesh in the file. glTF has neither maps of colours
    nor variants of splats. The file therefore shows the first option of each variant, with maps of colours
    applied to the harmonics. The original harmonics, the maps and the variants are kept beside them, where
    `load_scene` and `load_variants` find them and other programs ignore them. Empty slots and broken
    Gaussians are left out.

    Args:
        path: path of the file, which ends in .glb.
        scene: the scene; with variants, all parts are as without them.
        variants: the options to choose from.
        comments: lines to keep with the scene, beside the one that names its filter.

    Returns:
        The number of Gaussians in the file, counted once for each mesh.

    Raises:
        FormatError: if the file is no .glb file or cannot hold the scene: its parts were trained with
            different low-pass filters, or have SH above degree 3.
        ValueError: if the variants do not fit the scene.
    """
    path = Path(path)
    _check_suffix(path)
    nodes, meshes, lines, kept = written(path, scene, variants, comments)
    glb.write(path, meshes, nodes, lines, kept)
    return sum(len(mesh.gaussians) for mesh in meshes)


class Written(NamedTuple):
    """The contents of a file with a scene.

    Attributes:
        nodes: glTF's objects, one for each part.
        meshes: the splats, which nodes name by their index.
        lines: comments.
        kept: JSON values to keep with the scene.
    """

    nodes: list[dict[str, Any]]
    meshes: list[glb.Mesh]
    lines: tuple[str, ...]
    kept: dict[str, Any]


def written(path: Path, scene: Scene, variants: Variants, comments: tuple[str, ...]) -> Written:
    """Returns what a file keeps of a scene; the arguments and exceptions are those of `save_scene`."""
    filters = {part.gaussians.low_pass for part in scene.parts.values()}
    if len(filters) > 1:
        raise FormatError(
            f"{path}: a file names one low-pass filter, and the parts were trained with different ones. "
            "Train them alike."
        )
    shown = chosen(scene, variants)
    nodes, meshes = _drawn_parts(path, shown)
    for (name, part), node in zip(shown.parts.items(), nodes, strict=True):
        if part is not (own := scene[name]):
            node.setdefault("extras", {"splatax": {}})["splatax"]["alone"] = {
                "visible": bool(own.visible > 0),
                "color": numbers_of(own.color),
            }
    kept = {"variants": listed(variants)} if variants else {}
    order = common(part.gaussians.order for part in scene.parts.values())
    lines = (*marks_of(filters.pop(), order), *(line for line in comments if not is_mark(line)))
    return Written(nodes, meshes, lines, kept)


def _drawn_parts(path: Path, scene: Scene) -> tuple[list[dict[str, Any]], list[glb.Mesh]]:
    """Returns a node for each part of a scene, and the meshes that they place.

    Parts that share their Gaussians and colours share a mesh.

    Raises:
        FormatError: if a part has SH above degree 3. The message names the file.
    """
    meshes: dict[tuple[int, int], int] = {}
    made: list[glb.Mesh] = []
    nodes: list[dict[str, Any]] = []
    for name, part in scene.parts.items():
        if part.gaussians.sh_degree > glb.MAX_SH_DEGREE:
            raise FormatError(
                f"{path}: .glb holds SH up to degree {glb.MAX_SH_DEGREE}, and part {name!r} has degree "
                f"{part.gaussians.sh_degree}. Reduce it (splatax.editing.reduce_degree)."
            )
        shared = (id(part.gaussians), id(part.color))
        if shared not in meshes:
            meshes[shared] = len(made)
            made.append(_mesh(part))
        nodes.append(_node(name, part, meshes[shared]))
    return nodes, made


def _node(name: str, part: Part, mesh: int) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    pose = half_turned(part.pose)
    node: dict[str, Any] = {
        "name": name,
        "mesh": mesh,
        "rotation": Rotation.from_matrix(np.asarray(pose.rotation)).as_quat().tolist(),
        "translation": np.asarray(pose.translation, np.float64).tolist(),
        "scale": [float(pose.scale)] * 3,
    }
    if part.visible <= 0:
        node["extensions"] = {VISIBILITY: {"visible": False}}
    if part.color is not None:
        node["extras"] = {"splatax": {"color": numbers_of(part.color)}}
    return node


def half_turned(pose: Similarity) -> Similarity:
    """Returns a pose between our axes and glTF's; it undoes itself."""
    rotation, translation = np.asarray(pose.rotation), np.asarray(pose.translation)
    return Similarity(SIGNS[:, None] * rotation * SIGNS[None], SIGNS * translation, float(pose.scale))


def _mesh(part: Part) -> glb.Mesh:
    """Returns the sound Gaussians of a part, with and without its map of colours."""
    whole, keep = part.gaussians, sound_rows(part.gaussians)
    sound = whole if keep.all() else rows_of(whole, np.flatnonzero(keep))
    return glb.Mesh(sound) if part.color is None else glb.Mesh(part.color.transform(sound), sound)


def sound_rows(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Returns the Gaussians that files keep: neither broken ones nor empty slots."""
    return np.asarray(~broken(gaussians) & ~np.isneginf(np.asarray(gaussians.opacity_logits)))


def _unused(name: str, taken: Container[str]) -> str:
    number, found = 2, name
    while found in taken:
        found, number = f"{name} {number}", number + 1
    return found


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() != ".glb":
        raise FormatError(f"{path}: scenes of parts are kept in .glb files. Give the file such a name.")
