"""Structure of a .glb file: its chunks, the nodes with splats, and the arrays behind accessors."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from splatax.errors import FormatError, shown
from splatax.io.formats.untrusted import ALWAYS_ALLOWED, Cursor
from splatax.transforms import Similarity

EXTENSION = "KHR_gaussian_splatting"
VISIBILITY = "KHR_node_visibility"
ORIGINAL = "_SPLATAX_"  # before the names of harmonics without the map of colours that a part has in the file
PREFIXES = ("POSITION", f"{EXTENSION}:", ORIGINAL)
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
MAX_NODES = 10_000  # nodes that are visited; valid nodes form no cycle, but those of a damaged file may
MAX_REPETITION = 16  # mean number of times that the nodes of a file may repeat its splats
SMALLEST_ROW = 4 * (3 + 4 + 3 + 1 + 3)  # bytes in memory of a Gaussian with SH degree 0


class Glb(NamedTuple):
    """A .glb file that has been read.

    Attributes:
        path: path of the file, for messages.
        gltf: its JSON chunk.
        buffer: its binary chunk.
    """

    path: Path
    gltf: dict[str, Any]
    buffer: bytes


class Placed(NamedTuple):
    """The splats of one primitive, as a node of the scene has them.

    Attributes:
        primitive: glTF's object, whose accessors hold the splats.
        place: transform from the primitive to the scene.
        name: name of the node; empty if it has none.
        visible: False if the node or one above it is hidden.
        extras: notes of `splatax.io.scenes` at the node.
        skin: index of the skin that moves the splats; None if they stay.
    """

    primitive: dict[str, Any]
    place: Similarity
    name: str
    visible: bool
    extras: dict[str, Any]
    skin: int | None = None


def read(path: Path) -> Glb:
    """Reads the JSON chunk and the binary chunk of a file.

    Raises:
        FormatError: if the file is not a .glb file of version 2, or is truncated.
    """
    cursor = Cursor(path, path.read_bytes())
    magic, version, length = cursor.take("header", "<u4", 3).tolist()
    if magic != 0x46546C67 or version != 2:
        raise FormatError(f"{path}: not a .glb file of glTF 2.0. Give a file that was saved as .glb.")
    if length > len(cursor.contents):
        raise FormatError(
            f"{path}: truncated: {length - len(cursor.contents):,} of {length:,} bytes are missing."
        )
    found: dict[bytes, bytes] = {}
    while cursor.at + 8 <= length:
        size = int(cursor.take("chunk", "<u4", 1)[0])
        kind = cursor.take("chunk", "u1", 4).tobytes()
        found.setdefault(kind, cursor.take("chunk", "u1", size).tobytes())
    return Glb(path, json.loads(found[b"JSON"]), found.get(b"BIN\0", b""))


def splats(file: Glb) -> list[Placed]:
    """Returns the primitives that hold splats, as the scene's nodes place them, in the order of the nodes.

    Raises:
        FormatError: if there are none, or their compression is not supported.
    """
    found = []
    for node, place, visible in _nodes(file):
        if "mesh" not in node:
            continue
        for primitive in file.gltf["meshes"][node["mesh"]]["primitives"]:
            if (own := primitive.get("extensions", {}).get(EXTENSION)) is None:
                continue
            if own.get("extensions") or f"{EXTENSION}:SCALE" not in primitive["attributes"]:
                names = shown(", ".join(own.get("extensions", {}))) or "an unknown extension"
                raise FormatError(
                    f"{file.path}: its splats are compressed ({names}), which splatax does not read."
                )
            extras = node.get("extras", {}).get("splatax", {})
            name, skin = str(node.get("name", "")), node.get("skin")
            found.append(Placed(primitive, place, name, visible, extras, skin))
    if not found:
        raise FormatError(f"{file.path}: no splats: none of its meshes has the extension {EXTENSION}.")
    return found


def accessors(file: Glb, primitive: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns the splat attributes of a primitive as float32 arrays of n rows, by name.

    Raises:
        FormatError: if the arrays have different numbers of rows, or reach beyond the buffer.
    """
    arrays = {
        name: accessor(file, index)
        for name, index in primitive["attributes"].items()
        if name.startswith(PREFIXES)
    }
    count = len(arrays["POSITION"])
    for name, rows in arrays.items():
        if len(rows) != count:
            raise FormatError(
                f"{file.path}: damaged: {shown(name)} has {len(rows):,} rows, but POSITION has {count:,}. "
                "All attributes of its splats must have the same number. Get the file again."
            )
    return arrays


def check_repetition(file: Glb, primitives: list[dict[str, Any]], rows: str = "Gaussians") -> None:
    """Refuses a file whose nodes repeat its splats or meshes so often that memory would run out.

    Args:
        file: the file.
        primitives: of all nodes that are read.
        rows: name of the rows of a primitive, for the message.

    Raises:
        FormatError: if the nodes ask for too many rows.
    """
    counts = [
        file.gltf["accessors"][primitive["attributes"]["POSITION"]]["count"] for primitive in primitives
    ]
    if SMALLEST_ROW * sum(counts) > max(ALWAYS_ALLOWED, MAX_REPETITION * len(file.buffer)):
        raise FormatError(
            f"{file.path}: damaged: its nodes ask for {sum(counts):,} {rows}, far more than the "
            f"{len(file.buffer):,} bytes of the file hold. Get the file again."
        )


def _nodes(file: Glb) -> Iterator[tuple[dict[str, Any], Similarity, bool]]:
    """Yields the nodes of the scene in order, each with its place in the scene and whether it is visible."""
    nodes = file.gltf["nodes"]
    scene = file.gltf.get("scenes", [{"nodes": range(len(nodes))}])[file.gltf.get("scene", 0)]
    waiting = [(index, Similarity.of(), True) for index in reversed(scene["nodes"])]
    for _ in range(MAX_NODES):
        if not waiting:
            return
        index, parent, shown = waiting.pop()
        node = nodes[index]
        place = parent.after(_place(node))
        shown = shown and bool(node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True))
        yield node, place, shown
        waiting += [(child, place, shown) for child in reversed(node.get("children", ()))]
    raise FormatError(f"{file.path}: damaged: its nodes form a circle, or are more than {MAX_NODES:,}.")


def _place(node: dict[str, Any]) -> Similarity:
    """Returns the transform from a node to its parent. Splats cannot be sheared or scaled unevenly."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return Similarity(matrix[:3, :3] / scale, matrix[:3, 3], scale)
    scales = np.array(node.get("scale", (1, 1, 1)), np.float64)
    if not np.allclose(scales, scales[0]):
        raise ValueError(f"a node is scaled by {scales.tolist()}, not by the same along all axes")
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    return Similarity(rotation, np.array(node.get("translation", (0, 0, 0)), np.float64), float(scales[0]))


def accessor(file: Glb, index: int) -> np.ndarray:
    """Returns the rows of an accessor as float32; normalized integers are divided by their maximum.

    Raises:
        FormatError: if the accessor reaches beyond the buffer, or is sparse or outside the file.
    """
    path, gltf, buffer = file
    accessor = gltf["accessors"][index]
    view = gltf["bufferViews"][accessor["bufferView"]]
    if accessor.get("sparse") or view.get("buffer", 0) != 0 or "uri" in gltf["buffers"][0]:
        raise FormatError(
            f"{path}: stores arrays in another file or as sparse accessors, which splatax does not read."
        )
    dtype, width, count = (
        np.dtype(TYPES[accessor["componentType"]]),
        WIDTHS[accessor["type"]],
        accessor["count"],
    )
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", width * dtype.itemsize)
    if min(count, start, stride - width * dtype.itemsize) < 0:
        raise FormatError(f"{path}: damaged: an accessor with a negative size.")
    cursor = Cursor(path, buffer, start)
    if count:  # the last row may lack the padding up to its stride
        cursor.take("vertices", "u1", stride * (count - 1) + width * dtype.itemsize)
    rows = (
        np.ndarray((count, width), dtype, buffer, start, (stride, dtype.itemsize))
        if count
        else np.zeros((0, width))
    )
    values = rows.astype(np.float32)
    if accessor.get("normalized"):
        values = np.maximum(values / np.iinfo(dtype).max, -1)
    return values
