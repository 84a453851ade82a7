"""Poses from photos: the joints of a rigged scene are turned until its renderings match."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, UInt8

from splatax.dataset import View, mask_of
from splatax.errors import DatasetError, InputError
from splatax.losses import Photometric
from splatax.math import quaternions
from splatax.rendering import Color, render
from splatax.scene.rigged import RiggedScene
from splatax.scene.skeleton import Pose, spun
from splatax.scene.skin import skin
from splatax.training.camera_refinement import FINAL_RATE
from splatax.training.step import photo_over


@dataclass(frozen=True)
class Search:
    """Settings of a search for a pose.

    Attributes:
        steps: number of steps; each uses one photo, in turn.
        rate: learning rate of the rotation vectors at the start, radians per step; it falls log-linearly.
        background: RGB behind the scene.
        joints: names of the joints that may turn; None for all.
        stiffness: weights of the squared rotations, radians, of these joints from the rest pose about their
            own x, y and z axes, relative to the photometric loss. It keeps joints such as those of fingers
            from twisting and from bending sideways, which photos hardly show. 0 leaves an axis free.
    """

    steps: int = 200
    rate: float = 0.02
    background: Color = (0.0, 0.0, 0.0)
    joints: tuple[str, ...] | None = None
    stiffness: tuple[float, float, float] = (0.0, 0.0, 0.0)


def fit_pose(scene: RiggedScene, views: Sequence[View], start: Pose, search: Search = Search()) -> Pose:
    """Returns the pose of a rigged scene in photos that show it in one pose; see `pose_search`."""
    *_, (pose, _) = pose_search(scene, views, start, search)
    return pose


def pose_search(
    scene: RiggedScene, views: Sequence[View], start: Pose, search: Search = Search()
) -> Iterator[tuple[Pose, Float[Array, ""]]]:
    """Turns the joints of a pose, and yields the pose and the photo's loss after each step.

    Joints that carry no Gaussian have no gradient and stay. The scene does not change.

    Args:
        scene: Gaussians that look like the photos.
        views: photos of one pose, from one or more sides.
        start: pose near the one that is searched for.
        search: settings.

    Raises:
        DatasetError: if there are no photos, or one has another size than its camera.
        InputError: if there is no joint of a name, there are no steps, or a stiffness is below 0.
    """
    if not views:
        raise DatasetError("A pose is searched for in photos, and there are none.")
    if search.steps < 1:
        raise InputError(f"a search for a pose of {search.steps} steps. Give at least 1.")
    if min(search.stiffness) < 0:
        raise InputError(f"stiffness {search.stiffness} of joints. Give three numbers of at least 0.")
    behind = jnp.asarray(search.background, jnp.float32)
    photos = [(view.camera, photo_over(_pixels(view), behind), _mask(view)) for view in views]
    rule = optax.adam(optax.exponential_decay(search.rate, search.steps, FINAL_RATE))
    skeleton = scene.rig.skeleton
    turns, free = jnp.zeros((len(skeleton), 3)), np.ones((len(skeleton), 1), np.float32)
    if search.joints is not None:
        free[:] = 0
        free[[skeleton.index(name) for name in search.joints]] = 1
    state = rule.init(turns)
    springs = jnp.asarray(search.stiffness, jnp.float32)[None] * free / max(float(free.sum()), 1.0)
    for step in range(search.steps):
        camera, photo, mask = photos[step % len(photos)]
        arrays = scene.gaussians, scene.rig, start, turns
        loss, gradient = _compare(*arrays, camera, photo, mask, behind, springs)
        gradient = jnp.where(jnp.isfinite(gradient), gradient, 0) * free
        updates, state = rule.update(gradient, state)
        turns = turns + updates
        yield spun(start, turns), loss


def _pixels(view: View) -> UInt8[Array, "h w _"]:
    """Returns the photo of a view, whose size must be that of the camera."""
    pixels, camera = view.pixels(), view.camera
    if pixels.shape[:2] != (camera.height, camera.width):
        raise DatasetError(
            f"{view.name}: a photo of {pixels.shape[1]} x {pixels.shape[0]} pixels with a camera of "
            f"{camera.width} x {camera.height}. Give the camera of the photo's size (Camera.resized)."
        )
    return jnp.asarray(pixels)


def _mask(view: View) -> Array | None:
    mask = mask_of(view)
    return None if mask is None else jnp.asarray(mask)


@jax.jit
@partial(jax.value_and_grad, argnums=3)
def _compare(gaussians, rig, start, turns, camera, photo, mask, background, springs):
    pose, rest = spun(start, turns), rig.skeleton.rest
    posed = skin(gaussians, rig, rig.skeleton.worlds(pose))
    image = render(posed, camera, background=background).rgb
    bent = jax.vmap(_rotation_between)(rest.quats, pose.quats)
    return Photometric()(image, photo, mask) + jnp.sum(springs * bent * bent)


def _rotation_between(rest: Float[Array, "4"], quat: Float[Array, "4"]) -> Float[Array, "3"]:
    """Returns the rotation vector from one rotation to another about the axes of the first, radians."""
    back = quaternions.normalize(rest) * jnp.array([1, -1, -1, -1], rest.dtype)
    turn = quaternions.multiply(back, quaternions.normalize(quat))
    turn = jnp.where(turn[0] < 0, -turn, turn)
    squared = turn[1:] @ turn[1:]
    small = squared < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1, squared))
    factor = jnp.where(small, 2 + squared / 3, 2 * jnp.arctan2(sine, turn[0]) / sine)
    return factor * turn[1:]
