"""A scene from one camera: the Gaussians of each part, and the camera in the coordinates of the part.

Projecting a posed part equals projecting the part with its own camera, so no Gaussian is turned. Spherical
harmonics are then evaluated along the direction in the part's coordinates.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from splatax import gaussians as clouds
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.order import common
from splatax.scene.colors import ColorMap
from splatax.scene.parts import Part, Scene, masked
from splatax.shapes import check_arrays, check_kind
from splatax.transforms import Similarity

Drawable = Gaussians | Scene


def checked(scene: Drawable) -> Drawable:
    """Checks that the arrays of a scene fit together, and returns it with all its numbers as JAX arrays.

    It checks only shapes and dtypes, so it works on traced arrays.

    Raises:
        TypeError: if it is no scene.
        ValueError: if a shape or dtype is wrong. The message names the part.
    """
    check_kind(
        "the scene", scene, Drawable, "Give Gaussians, or a Scene of parts; the camera comes after it."
    )
    if isinstance(scene, Gaussians):
        return clouds.checked(scene)
    return Scene({name: _checked(name, part) for name, part in scene.parts.items()})


def _checked(name: str, part: Part) -> Part:
    matrix = "Give a Similarity, such as Similarity(matrix[:3, :3], matrix[:3, 3])."
    check_kind(f"the pose of part {name!r}", part.pose, Similarity, matrix)
    check_kind(f"the color of part {name!r}", part.color, ColorMap | None, "Give a ColorMap.")
    check_kind(
        f"gaussians of part {name!r}", part.gaussians, Gaussians, "Give Gaussians, such as those of a file."
    )
    try:
        gaussians = clouds.checked(part.gaussians)
        dtype = gaussians.means.dtype
        pose = part.pose.cast(dtype)
        color = None if part.color is None else jax.tree.map(lambda x: jnp.asarray(x, dtype), part.color)
        visible = jnp.asarray(part.visible, dtype)
        arrays = {
            "pose.rotation": (pose.rotation, "3 3"),
            "pose.translation": (pose.translation, "3"),
            "pose.scale": (pose.scale, ""),
            "visible": (visible, ""),
        }
        if color is not None:
            arrays |= {"color.matrix": (color.matrix, "3 3"), "color.offset": (color.offset, "3")}
        check_arrays("Part", arrays)
    except ValueError as error:
        raise ValueError(f"part {name!r}: {error}") from error
    return Part(gaussians, pose, visible, color)


def clouds_of(scene: Drawable) -> dict[str, Gaussians]:
    """Returns the Gaussians of each part by its name; Gaussians alone are one part without a name."""
    if isinstance(scene, Gaussians):
        return {"": scene}
    return {name: part.gaussians for name, part in scene.parts.items()}


def means_of(scene: Drawable) -> dict[str, Array]:
    """Returns the means of the Gaussians by name, for checks of dtypes."""
    return {
        f"means of part {name!r}" if name else "means": gaussians.means
        for name, gaussians in clouds_of(scene).items()
    }


def sizes_of(scene: Drawable) -> tuple[int, ...]:
    """Returns the number of Gaussians of each part; Gaussians alone are one part."""
    return tuple(map(len, clouds_of(scene).values()))


def seen_from(scene: Drawable, camera: Camera) -> list[tuple[Gaussians, Camera]]:
    """Returns the Gaussians of each part and the camera that sees them as `camera` sees the part.

    Parts that were trained in different orders get the one that they have in common. The Gaussians are in
    world units, so depths, and the distance at which they are culled, are those of the world.
    """
    if isinstance(scene, Gaussians):
        return [(scene, camera)]
    order = common(part.gaussians.order for part in scene.parts.values())
    seen = [_seen(part, camera) for part in scene.parts.values()]
    return [(replace(gaussians, order=order), own) for gaussians, own in seen]


@jax.default_matmul_precision("highest")
def _seen(part: Part, camera: Camera) -> tuple[Gaussians, Camera]:
    gaussians, pose = part.gaussians, part.pose
    if part.color is not None:
        gaussians = part.color.transform(gaussians)
    finite = jnp.isfinite(gaussians.means)  # zero times NaN would spoil the gradient of the scale
    scaled = jnp.where(finite, jnp.where(finite, gaussians.means, 0) * pose.scale, gaussians.means)
    sized = gaussians.log_scales + jnp.log(pose.scale)
    gaussians = masked(replace(gaussians, means=scaled, log_scales=sized), part.visible)
    top = jnp.concatenate([pose.rotation, pose.translation[:, None]], axis=1)
    world_from_part = jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], top.dtype)])
    return gaussians, replace(camera, cam_from_world=camera.cam_from_world @ world_from_part)


def in_world(scene: Drawable) -> Gaussians:
    """Returns the Gaussians of all parts in the world, hidden ones too, in the order of the scene's rows."""
    if isinstance(scene, Gaussians):
        return scene
    placed = [part.in_world() for part in scene.parts.values()]
    return clouds.joined([replace(part, low_pass=placed[0].low_pass) for part in placed])
