"""Writes meshes: .ply and .obj in the scene's own axes, .glb upright as the .glb of its splats."""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from splatax.errors import InputError
from splatax.io.files import write_whole
from splatax.mesh.record import Mesh

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125  # glTF's component types
VERTICES, INDICES = 34962, 34963  # glTF's buffer targets
UNLIT = "KHR_materials_unlit"
HALF_TURN = np.array([-1, -1, 1])  # around z: from y down to y up


def save(path: str | Path, mesh: Mesh) -> None:
    """Writes a mesh with colours. The suffix selects the format. A crash leaves an old file as it was.

    Args:
        path: .ply (binary), .obj (text, colours behind the positions) or .glb (glTF, unlit, y up).
        mesh: the mesh.

    Raises:
        InputError: if the suffix is none of these.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    write_whole(path, WRITERS[suffix_of(path)](mesh))


def suffix_of(path: Path) -> str:
    """Returns the suffix of a mesh's file.

    Raises:
        InputError: if there is no format with this suffix.
    """
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise InputError(f"{path}: no format of meshes. Write {', '.join(WRITERS)}.")
    return suffix


def ply(mesh: Mesh) -> bytes:
    """Returns the contents of a binary .ply with normals and sRGB colours."""
    coordinates = ("x", "y", "z", "nx", "ny", "nz")
    channels = ("red", "green", "blue")
    vertices = np.zeros(
        len(mesh.vertices), [*((name, "<f4") for name in coordinates), *((name, "u1") for name in channels)]
    )
    for name, values in zip(coordinates, [*mesh.vertices.T, *mesh.normals.T], strict=True):
        vertices[name] = values
    for name, values in zip(channels, mesh.colors.T, strict=True):
        vertices[name] = values
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("rows", "<i4", 3)])
    faces["count"], faces["rows"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment splatax",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in coordinates),
        *(f"property uchar {name}" for name in channels),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def obj(mesh: Mesh) -> bytes:
    """Returns the contents of an .obj with sRGB colours in [0, 1] behind the positions."""
    text = io.StringIO("# splatax\n")
    text.seek(0, io.SEEK_END)
    np.savetxt(text, np.column_stack([mesh.vertices, mesh.colors / 255]), "v %.7g %.7g %.7g %.4f %.4f %.4f")
    np.savetxt(text, mesh.normals, "vn %.4f %.4f %.4f")
    np.savetxt(text, np.repeat(mesh.faces + 1, 2, axis=1), "f %d//%d %d//%d %d//%d")
    return text.getvalue().encode()


def glb(mesh: Mesh) -> bytes:
    """Returns the contents of a .glb: y up, linear colours of 16 bits, shown without lights."""
    colors = np.full((len(mesh.colors), 4), 65535, "<u2")
    colors[:, :3] = np.round(65535 * linear(mesh.colors))
    arrays: list[tuple[np.ndarray, dict[str, Any], int]] = [
        ((mesh.vertices * HALF_TURN).astype("<f4"), {"componentType": FLOAT, "type": "VEC3"}, VERTICES),
        ((mesh.normals * HALF_TURN).astype("<f4"), {"componentType": FLOAT, "type": "VEC3"}, VERTICES),
        (colors, {"componentType": UNSIGNED_SHORT, "normalized": True, "type": "VEC4"}, VERTICES),
        (mesh.faces.astype("<u4").ravel(), {"componentType": UNSIGNED_INT, "type": "SCALAR"}, INDICES),
    ]
    accessors, views, offset = [], [], 0
    for number, (values, kind, target) in enumerate(arrays):
        accessors.append({"bufferView": number, "count": len(values), **kind})
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": target})
        offset += values.nbytes  # all are multiples of 4
    positions = arrays[0][0]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    surface = {"metallicFactor": 0, "roughnessFactor": 1}
    gltf = {
        "asset": {"version": "2.0", "generator": "splatax"},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {UNLIT: {}}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset)
    parts = [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", offset, b"BIN\0")]
    return b"".join([*parts, *(values.tobytes() for values, _, _ in arrays)])


def linear(colors: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns linear light, in [0, 1], of sRGB colours (IEC 61966-2-1), as glTF's vertex colours need it."""
    srgb = colors / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


WRITERS: dict[str, Callable[[Mesh], bytes]] = {".ply": ply, ".glb": glb, ".obj": obj}
