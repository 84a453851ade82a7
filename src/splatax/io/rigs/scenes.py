"""Rigged scenes in .glb files.

The file is a mesh of points with KHR_gaussian_splatting, a skin and animations. Viewers that draw splats but
know no skins of splats show it in the bound pose.
"""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import broken
from splatax.io.formats import glb, glb_scene
from splatax.io.formats.glb_scene import EXTENSION
from splatax.io.formats.marks import mark, marked
from splatax.io.formats.untrusted import structured
from splatax.io.rigs.following import check_following
from splatax.io.rigs.nodes import read_skeleton
from splatax.io.rigs.writing import POINTS, Beside, Skinned, joints_attributes, write_skinned
from splatax.io.scenes import drawn_parts
from splatax.scene import Scene
from splatax.scene.rigged import RiggedScene
from splatax.scene.skin import Rig
from splatax.transforms import Similarity, half_turn

PLACED = 1e-4  # difference from the identity up to which splats are in the bound pose as they are


def save_rigged(
    path: str | Path,
    scene: RiggedScene,
    *,
    comments: tuple[str, ...] = (),
    name: str = "skinned",
    beside: Scene | None = None,
) -> None:
    """Writes a rigged scene as a .glb file. Each Gaussian keeps its four strongest joints.

    Empty slots are left out, and broken Gaussians too, with a warning that counts them. The file names the
    low-pass filter of the scene.

    Args:
        path: path of the file.
        scene: the Gaussians, their rig and its clips.
        comments: lines to keep with the scene, beside the one that names its filter.
        name: name of the part that has the skin, for `splatax.load_scene`.
        beside: further parts, which do not follow the skeleton; None for none. `splatax.load_scene` reads
            them, and the skinned part in its bound pose.

    Raises:
        FormatError: if the SH degree is above 3, or if further parts have the name of the skinned one or were
            trained with another low-pass filter.
    """
    path = Path(path)
    standing = _beside(path, scene, name, beside)
    if scene.gaussians.sh_degree > glb.MAX_SH_DEGREE:
        raise FormatError(
            f"{path}: .glb holds SH up to degree {glb.MAX_SH_DEGREE}, and the scene has degree "
            f"{scene.gaussians.sh_degree}. Reduce it first (splatax.editing.reduce_degree)."
        )
    rig, whole = scene.rig, scene.gaussians
    wrong, empty = broken(whole), np.isneginf(np.asarray(whole.opacity_logits))
    if count := int(np.sum(wrong & ~empty)):
        warnings.warn(f"{path}: left out {count:,} Gaussians that are not finite", stacklevel=2)
    keep = ~wrong & ~empty
    gaussians = jax.tree.map(lambda leaf: leaf[keep], whole)
    indices, weights = (np.asarray(rows)[keep] for rows in (rig.indices, rig.weights))
    attributes = glb.attributes_of(half_turn(gaussians, axis=2))
    attributes |= joints_attributes(indices, weights, len(rig.skeleton))
    lines = (mark(whole.low_pass), *comments)
    mesh = Skinned(attributes, POINTS, name=name)
    write_skinned(path, rig.skeleton, scene.clips, mesh, lines, standing)


def _beside(path: Path, scene: RiggedScene, name: str, beside: Scene | None) -> Beside:
    """Returns the nodes and meshes of the parts beside a skinned one."""
    if beside is None:
        return Beside()
    if name in beside.names:
        raise FormatError(f"{path}: two parts are called {name!r}. Give the skinned part another name.")
    if {part.gaussians.low_pass for part in beside.parts.values()} != {scene.gaussians.low_pass}:
        raise FormatError(
            f"{path}: a file names one low-pass filter, and the parts were trained with different ones. "
            "Train them alike."
        )
    nodes, meshes = drawn_parts(path, beside)
    return Beside(nodes, [glb.arrays_of(mesh) for mesh in meshes])


def load_rigged(path: str | Path) -> RiggedScene:
    """Reads a .glb file whose splats have a skin.

    Raises:
        FormatError: if the file is missing or damaged, or has no splats with one skin.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a .glb file that splatax rig or splatax bind wrote.")
    with structured(path, ".glb"):
        gltf, buffer = glb_scene.chunks(path)
        found = [
            (node["skin"], primitive)
            for node in gltf.get("nodes", ())
            if "mesh" in node and "skin" in node
            for primitive in gltf["meshes"][node["mesh"]]["primitives"]
            if EXTENSION in primitive.get("extensions", {})
        ]
        if len(found) != 1:
            raise FormatError(
                f"{path}: {len(found)} meshes of splats with a skin, where one is needed. Bind a scan to a "
                "body: splatax bind."
            )
        ((number, primitive),) = found
        skeleton, clips, _, binding = read_skeleton(path, gltf, buffer)
        gaussians = glb.gaussians_of(glb_scene.accessors(path, gltf, buffer, primitive))
        place = binding.placed[number]
        if np.abs(place - np.eye(4)).max() > PLACED:
            scale = float(np.cbrt(np.linalg.det(place[:3, :3])))
            gaussians = Similarity(place[:3, :3] / scale, place[:3, 3], scale).transform(gaussians)
        attributes = primitive["attributes"]
        joints, weights = (
            glb_scene.accessor(path, gltf, buffer, attributes[name]) for name in ("JOINTS_0", "WEIGHTS_0")
        )
        if not len(gaussians) == len(joints) == len(weights):
            raise FormatError(f"{path}: damaged: not every splat has joints and weights. Get the file again.")
        known = binding.joints[number]
        indices = known[check_following(path, joints, weights, len(known))]
        gaussians = marked(gaussians, glb.comments(path))
    sums = np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    rig = Rig(skeleton, jnp.asarray(indices, jnp.int32), jnp.asarray(weights / sums, jnp.float32))
    return RiggedScene(half_turn(gaussians, axis=2), rig, clips)
