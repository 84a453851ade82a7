"""Rigged scenes in .glb files.

The file has a mesh of points with KHR_gaussian_splatting for each part. Parts that follow the skeleton have a
skin, and animations move it. Viewers that draw splats but know no skins of splats show the bound pose.
"""

import warnings
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from splatax.errors import FormatError
from splatax.gaussians import broken
from splatax.io.formats import glb, glb_scene
from splatax.io.formats.glb_scene import Glb, Placed
from splatax.io.formats.untrusted import structured
from splatax.io.rigs.following import check_following
from splatax.io.rigs.nodes import read_skeleton
from splatax.io.rigs.writing import FOLLOWS, Mesh, joints_attributes, write_skinned
from splatax.io.scenes import NO_VARIANTS, half_turned, names_of, opened, scene_in, sound_rows, written
from splatax.scene import Part, Scene, Variants
from splatax.scene.rigged import AnimatedScene, RiggedScene
from splatax.scene.skeleton import Skeleton
from splatax.scene.skin import Rig
from splatax.transforms import Similarity

PLACED = 1e-4  # difference from the identity up to which splats are in the bound pose as they are
IDENTITY = Similarity(np.eye(3), np.zeros(3))
OWN = ("translation", "rotation", "scale")  # of a node; glTF ignores them where its mesh has a skin


def save_animated(
    path: str | Path,
    animated: AnimatedScene,
    *,
    variants: Variants = NO_VARIANTS,
    comments: tuple[str, ...] = (),
) -> None:
    """Writes parts, their skins and the clips as a .glb file, which `load_animated` reads.

    Each Gaussian of a skinned part keeps its four strongest joints. The pose of the skinned parts is applied
    to their Gaussians and to the skeleton. Empty slots are left out, and broken Gaussians too, with a warning
    that counts those of skinned parts. Maps of colours and variants are kept as by `save_scene`.

    Args:
        path: path of the file.
        animated: the parts, rigs and clips, with at least one rig.
        variants: the options to choose from, as for `save_scene`.
        comments: lines to keep with the scene, beside the one that names its filter.

    Raises:
        FormatError: if no part has a rig, skinned parts have different poses, the SH degree is above 3, or
            parts were trained with different low-pass filters.
        ValueError: if the variants do not fit the scene.
    """
    path, rigs = Path(path), animated.rigs
    if not rigs:
        raise FormatError(f"{path}: no part follows a skeleton. Save the scene with save_scene.")
    skeleton, parts = _in_place(path, animated)
    scene = Scene(parts)
    for name in rigs:
        wrong = broken(parts[name].gaussians) & ~np.isneginf(np.asarray(parts[name].gaussians.opacity_logits))
        if count := int(np.sum(wrong)):
            warnings.warn(f"{path}: left out {count:,} Gaussians that are not finite", stacklevel=2)
    nodes, splats, lines, kept = written(path, scene, variants, comments)
    arrays = [glb.arrays_of(mesh) for mesh in splats]
    for node in nodes:
        if (rig := rigs.get(node["name"])) is not None:
            keep = sound_rows(parts[node["name"]].gaussians)
            indices, weights = (np.asarray(values)[keep] for values in (rig.indices, rig.weights))
            arrays[node["mesh"]] |= joints_attributes(indices, weights, len(skeleton))
            for key in OWN:
                del node[key]
            node |= FOLLOWS
    kind = glb.points(splats)
    meshes = [Mesh(attributes, kind) for attributes in arrays]
    write_skinned(path, skeleton, animated.clips, meshes, nodes, lines, kept)


def _in_place(path: Path, animated: AnimatedScene) -> tuple[Skeleton, dict[str, Part]]:
    """Returns the skeleton and the parts with the pose of the skinned parts applied, which becomes none.

    Skinned parts get Gaussians of their own, so that they share no mesh with other parts.
    """
    skinned = {name: animated.scene[name] for name in animated.rigs}
    poses = [part.pose.matrix for part in skinned.values()]
    if any(np.abs(pose - poses[0]).max() > 1e-6 * max(np.abs(poses[0]).max(), 1) for pose in poses):
        raise FormatError(
            f"{path}: parts that follow the skeleton have different poses. Give {', '.join(skinned)} "
            "one pose."
        )
    first = next(iter(skinned.values()))
    still = np.array_equal(poses[0], np.eye(4))
    moved = {
        name: replace(
            part,
            gaussians=replace(part.gaussians) if still else part.pose.transform(part.gaussians),
            pose=IDENTITY,
        )
        for name, part in skinned.items()
    }
    skeleton = animated.skeleton if still else animated.skeleton.moved(first.pose)
    return skeleton, {**animated.scene.parts, **moved}


def load_animated(path: str | Path) -> AnimatedScene:
    """Reads the parts of a .glb file with their skins and clips.

    Parts have the names of `splatax.load_scene`. Those with a skin are in the pose in which they were bound,
    in the coordinates of the skeleton. A file without skins has no rigs and no clips.

    Raises:
        FormatError: if the file is missing or damaged, has no splats, or a skin or clip is not valid.
    """
    with opened(path) as file:
        return animated_in(file, scene_in(file))


def animated_in(file: Glb, scene: Scene) -> AnimatedScene:
    """Returns the parts of a file with their skins and clips; see `load_animated`.

    Args:
        file: the file.
        scene: its parts, by the names of `splatax.load_scene`.
    """
    placed = glb_scene.splats(file)
    if all(at.skin is None for at in placed):
        return AnimatedScene(scene, {})
    skeleton, clips, _, binding = read_skeleton(file)
    rigs, parts = {}, dict(scene.parts)
    for name, at in zip(names_of(placed), placed, strict=True):
        if at.skin is None:
            continue
        rigs[name] = _rig(file, at, skeleton, binding.joints[at.skin])
        if len(rigs[name].weights) != len(parts[name].gaussians):
            raise FormatError(
                f"{file.path}: damaged: not every splat has joints and weights. Get the file again."
            )
        parts[name] = _bound(parts[name], binding.placed[at.skin])
    return AnimatedScene(Scene(parts), rigs, clips)


def _rig(file: Glb, at: Placed, skeleton: Skeleton, known: Int[np.ndarray, " _"]) -> Rig:
    """Returns the rig of splats; `known` are the joints of their skin among those of the skeleton."""
    attributes = at.primitive["attributes"]
    joints, weights = (glb_scene.accessor(file, attributes[name]) for name in ("JOINTS_0", "WEIGHTS_0"))
    if len(joints) != len(weights):
        raise FormatError(
            f"{file.path}: damaged: not every splat has joints and weights. Get the file again."
        )
    indices = known[check_following(file.path, joints, weights, len(known))]
    sums = np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    return Rig(skeleton, jnp.asarray(indices, jnp.int32), jnp.asarray(weights / sums, jnp.float32))


def _bound(part: Part, place: np.ndarray) -> Part:
    """Returns a part in the pose in which it was bound; `place` is where glTF's world has its frame then."""
    if np.abs(place - np.eye(4)).max() <= PLACED:
        return replace(part, pose=IDENTITY)
    scale = float(np.cbrt(np.linalg.det(place[:3, :3])))
    here = half_turned(Similarity(place[:3, :3] / scale, place[:3, 3], scale))
    return replace(part, gaussians=here.transform(part.gaussians), pose=IDENTITY)


def save_rigged(
    path: str | Path,
    scene: RiggedScene,
    *,
    comments: tuple[str, ...] = (),
    name: str = "skinned",
    beside: Scene | None = None,
) -> None:
    """Writes a rigged scene as a .glb file; see `save_animated`.

    Args:
        path: path of the file.
        scene: the Gaussians, their rig and its clips.
        comments: lines to keep with the scene, beside the one that names its filter.
        name: name of the part that has the skin.
        beside: further parts, which do not follow the skeleton; None for none.

    Raises:
        FormatError: if the SH degree is above 3, or if further parts have the name of the skinned one or were
            trained with another low-pass filter.
    """
    parts = dict(beside.parts) if beside else {}
    if name in parts:
        raise FormatError(f"{path}: two parts are called {name!r}. Give the skinned part another name.")
    whole = Scene({name: Part(scene.gaussians), **parts})
    save_animated(path, AnimatedScene(whole, {name: scene.rig}, scene.clips), comments=comments)


def load_rigged(path: str | Path) -> RiggedScene:
    """Reads the only part with a skin of a .glb file, in its bound pose, with the clips of the file.

    `load_animated` reads all parts.

    Raises:
        FormatError: if the file is missing or damaged, or has no splats with one skin.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file. Give a .glb file that splatax rig or splatax bind wrote.")
    with structured(path, ".glb"):
        file = glb_scene.read(path)
        if (count := _skinned_splats(file)) != 1:
            raise FormatError(
                f"{path}: {count} meshes of splats with a skin, where one is needed. Bind a scan to a body: "
                "splatax bind."
            )
        animated = animated_in(file, scene_in(file))
    ((name, rig),) = animated.rigs.items()
    part = animated.scene[name]
    gaussians = part.gaussians if part.color is None else part.color.transform(part.gaussians)
    return RiggedScene(gaussians, rig, animated.clips)


def _skinned_splats(file: Glb) -> int:
    """Returns the number of meshes of splats in the scene of a file that have a skin."""
    primitives = [primitive for mesh in file.gltf.get("meshes", ()) for primitive in mesh["primitives"]]
    if not any(glb_scene.EXTENSION in primitive.get("extensions", {}) for primitive in primitives):
        return 0
    return sum(at.skin is not None for at in glb_scene.splats(file))
