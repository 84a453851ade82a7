"""glTF's .glb with the extension KHR_gaussian_splatting: a mesh of points with more attributes.

    POSITION  COLOR_0  KHR_gaussian_splatting:ROTATION (x, y, z, w)  :SCALE  :OPACITY  :SH_DEGREE_l_COEF_n

Scales are linear and opacities in [0, 1] (drafts before spring 2026 had logarithms of scales:
KhronosGroup/glTF#2563). glTF is left-up-forward, ours right-down-forward: half a turn around z.
COLOR_0 is for viewers that can only draw points.
"""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians, checked, joined
from splatax.io.files import write_whole
from splatax.io.formats import glb_scene, packing
from splatax.io.formats.glb_scene import EXTENSION, ORIGINAL, Glb, Placed
from splatax.io.formats.marks import MARKS
from splatax.io.formats.tolerance import Tolerance
from splatax.math import harmonics
from splatax.order import Order, common
from splatax.transforms import half_turn

FLOAT, UNSIGNED_BYTE = 5126, 5121  # glTF's component types
VERTICES = 34962  # glTF's buffer target for vertex attributes
EMPTY: Mapping[str, Any] = MappingProxyType({})
SORTING: dict[Order, str] = {"depth": "zDepth", "distance": "cameraDistance"}  # property sortingMethod
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
PROPERTIES = {  # of the extension, as this engine draws splats; beside them, how it sorts them
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
}

HARMONICS = f"{EXTENSION}:"  # before the names of harmonics as every reader draws them

MAX_SH_DEGREE = 3
LOSES = "only rounding: opacities and scales are stored as such, not as logits and logarithms."
KEPT_MARKS = MARKS
TOLERANCE = Tolerance(degrees=1e-3, log_scales=1e-5, opacities=1e-6)


class Mesh(NamedTuple):
    """Gaussians to write, in our axes.

    Attributes:
        gaussians: as every reader draws them.
        original: the same Gaussians before their colours were mapped; None if they are as they were.
    """

    gaussians: Gaussians
    original: Gaussians | None = None


def load(path: Path) -> Gaussians:
    """Reads all visible splats of a file's scene, transformed by their nodes. `io.scenes` keeps the nodes.

    Raises:
        FormatError: if the file is damaged, or has no visible splats.
    """
    shown = [(place, gaussians) for place, gaussians in placed(glb_scene.read(path)) if place.visible]
    if not shown:
        raise FormatError(f"{path}: all its splats are hidden. Show some, or read it with load_scene.")
    return half_turn(joined([at.place.transform(gaussians) for at, gaussians in shown]), axis=2)


def placed(file: Glb, harmonics: str = HARMONICS) -> list[tuple[Placed, Gaussians]]:
    """Returns the splats of each primitive in its own frame, and their nodes, in the axes of glTF.

    Nodes that share a primitive share the Gaussians.

    Args:
        file: the file.
        harmonics: prefix of the names of the harmonics to read: `HARMONICS`, or `ORIGINAL` for those
            before the map of colours that is noted at a node, where there is one.

    Raises:
        FormatError: if the file is damaged, or has no splats.
    """
    found = glb_scene.splats(file)
    glb_scene.check_repetition(file, [at.primitive for at in found])
    read: dict[tuple[int, str], Gaussians] = {}
    result = []
    for at in found:
        # Other programs may have dropped the map: the harmonics with the map applied are then the colours.
        key = id(at.primitive), harmonics if "color" in at.extras else HARMONICS
        if key not in read:
            read[key] = gaussians_of(glb_scene.accessors(file, at.primitive), key[1])
        result.append((at, read[key]))
    return result


def comments(path: Path) -> tuple[str, ...]:
    """Returns the comment lines that `save` wrote to the file's extras."""
    return comments_in(glb_scene.read(path))


def comments_in(file: Glb) -> tuple[str, ...]:
    """Returns the comment lines that `save` wrote to the extras of a file."""
    asset = file.gltf.get("asset", {})
    return tuple(str(line) for line in asset.get("extras", {}).get("comments", ()))


def save(path: Path, gaussians: Gaussians, *, comments: tuple[str, ...] = ()) -> None:
    """Writes float32 attributes of one mesh."""
    write(path, [Mesh(gaussians)], [{"mesh": 0}], comments)


def extras_in(file: Glb) -> dict[str, Any]:
    """Returns what `write` kept with the scene, by name."""
    scene = (file.gltf.get("scenes") or [{}])[file.gltf.get("scene", 0)]
    return dict(scene.get("extras", {}).get("splatax", {}))


def write(
    path: Path,
    meshes: Sequence[Mesh],
    nodes: Sequence[dict[str, Any]],
    comments: tuple[str, ...],
    kept: Mapping[str, Any] = EMPTY,
) -> None:
    """Writes a file with meshes of splats, and nodes that place them.

    Args:
        path: the file.
        meshes: each becomes a mesh with one primitive.
        nodes: glTF's objects, in glTF's axes; all are roots of the scene.
        comments: lines for the file's extras.
        kept: JSON values to keep with the scene, which other readers ignore.
    """
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    chunks: list[bytes] = []
    kind = points(meshes)
    primitives = [{"attributes": _attributes(mesh, accessors, views, chunks), **kind} for mesh in meshes]
    offset = sum(map(len, chunks))
    used = {EXTENSION, *(name for node in nodes for name in node.get("extensions", ()))}
    scene: dict[str, Any] = {"nodes": list(range(len(nodes)))}
    if kept:
        scene["extras"] = {"splatax": dict(kept)}
    gltf = {
        "asset": {"version": "2.0", "generator": "splatax", "extras": {"comments": list(comments)}},
        "extensionsUsed": sorted(used),
        "scene": 0,
        "scenes": [scene],
        "nodes": list(nodes),
        "meshes": [{"primitives": [primitive]} for primitive in primitives],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + offset
    head = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(text), b"JSON") + text
    write_whole(path, b"".join([head, struct.pack("<I4s", offset, b"BIN\0"), *chunks]))


def _attributes(
    mesh: Mesh, accessors: list[dict[str, Any]], views: list[dict[str, Any]], chunks: list[bytes]
) -> dict[str, int]:
    """Appends the attributes of Gaussians to the file's lists, and returns their accessors by name."""
    arrays = arrays_of(mesh)
    attributes = {}
    offset = sum(map(len, chunks))
    for name, values in arrays.items():
        attributes[name] = len(accessors)
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "count": len(values),
            "type": KINDS[values.shape[1]],
        }
        accessor["componentType"] = UNSIGNED_BYTE if values.dtype == np.uint8 else FLOAT
        if values.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION" and len(values):
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": VERTICES})
        chunks.append(values.tobytes())
        offset += values.nbytes  # all are multiples of 4
    return attributes


def points(meshes: Sequence[Mesh]) -> dict[str, Any]:
    """Returns what each primitive of a file has beside its attributes. All splats are sorted together."""
    order = common(mesh.gaussians.order for mesh in meshes)
    return {"mode": 0, "extensions": {EXTENSION: PROPERTIES | {"sortingMethod": SORTING[order]}}}


def arrays_of(mesh: Mesh) -> dict[str, np.ndarray]:
    """Returns the attributes of a mesh of splats by name, in glTF's frame."""
    arrays = attributes_of(half_turn(mesh.gaussians, axis=2))
    if mesh.original is not None:
        arrays |= harmonics_of(half_turn(mesh.original, axis=2), ORIGINAL)
    return arrays


def attributes_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Returns the attributes of a mesh of splats by name, in glTF's frame if the scene is."""
    sh = np.asarray(gaussians.sh)
    opacities = np.asarray(gaussians.opacities)[:, None]
    rgb = packing.levels(harmonics.to_rgb(sh[:, 0]), 255).astype("u1")
    attributes = {
        "POSITION": np.asarray(gaussians.means),
        "COLOR_0": np.concatenate([rgb, packing.levels(opacities, 255).astype("u1")], axis=1),
        f"{EXTENSION}:ROTATION": packing.unit(np.asarray(gaussians.quats))[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.asarray(gaussians.scales),
        f"{EXTENSION}:OPACITY": opacities,
    }
    attributes = {
        name: values if values.dtype == np.uint8 else np.ascontiguousarray(values, "<f4")
        for name, values in attributes.items()
    }
    return attributes | harmonics_of(gaussians, HARMONICS)


def harmonics_of(gaussians: Gaussians, prefix: str) -> dict[str, np.ndarray]:
    """Returns the attributes of spherical harmonics by name, one for each coefficient."""
    sh = np.asarray(gaussians.sh)
    return {
        f"{prefix}SH_DEGREE_{band}_COEF_{i}": np.ascontiguousarray(sh[:, band**2 + i], "<f4")
        for band in range(gaussians.sh_degree + 1)
        for i in range(2 * band + 1)
    }


def gaussians_of(attributes: dict[str, np.ndarray], prefix: str = HARMONICS) -> Gaussians:
    """Returns the scene that attributes of a mesh of splats describe, in the frame of the attributes.

    Args:
        attributes: by name.
        prefix: see `placed`.
    """
    found = prefix if f"{prefix}SH_DEGREE_0_COEF_0" in attributes else HARMONICS
    coefficients = []
    for band in range(MAX_SH_DEGREE + 1):
        names = [f"{found}SH_DEGREE_{band}_COEF_{i}" for i in range(2 * band + 1)]
        if names[0] in attributes:
            coefficients += [attributes[name] for name in names]
    with np.errstate(divide="ignore"):
        log_scales = np.log(attributes[f"{EXTENSION}:SCALE"])
    opacities = attributes[f"{EXTENSION}:OPACITY"][:, 0].astype(np.float64)
    opacities = np.clip(opacities, 1e-7, 1 - 1e-7)  # a logit must stay finite
    gaussians = Gaussians(
        means=jnp.asarray(attributes["POSITION"]),
        quats=jnp.asarray(attributes[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]]),
        log_scales=jnp.asarray(log_scales),
        opacity_logits=jnp.asarray(np.log(opacities / (1 - opacities)), jnp.float32),
        sh=jnp.asarray(np.stack(coefficients, axis=1)),
    )
    return checked(gaussians)
