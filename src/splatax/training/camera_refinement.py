"""What training may change of the cameras that took the photos."""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.camera import Camera
from splatax.dataset import View
from splatax.math import rigid
from splatax.training import per_photo
from splatax.training.feed import Source, sources
from splatax.training.per_photo import NoParameters, PerPhoto

FALL = 0.01  # what the rates end at, of what they start at (as in gsplat)


@dataclass(frozen=True)
class FixedCameras(NoParameters):
    """Nothing: the cameras are as they were given."""

    def __call__(self, known: tuple[()], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """The camera as it is now thought to be."""
        return camera


@dataclass(frozen=True)
class Poses:
    """Where each photo was taken from: a twist for each, from the left on `cam_from_world`.

    A twist turns a camera about its own centre, and moves it. Its numbers are along the axes of the
    world, radians and extents of the scene. If all cameras turned and moved together with the scene,
    no photo could tell; so the mean twist over photos is held at zero. That spreads what the given
    poses have in common evenly, where to hold one camera still would trust that one alone.
    """

    reach: float = 0.02  # how far a camera can go in a whole run: radians, and extents of the scene

    def init(self, photos: int) -> PerPhoto:
        """Cameras as they were given: a row has a rotation and a translation."""
        return per_photo.zeros(photos, 6)

    def of(self, state: PerPhoto, source: Source) -> Float[Array, "6"]:
        """The twist of a photo's camera."""
        return state.values[source.view]

    @jax.default_matmul_precision("highest")
    def __call__(self, known: Float[Array, "6"], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """The camera as it is now thought to be."""
        rotation, translation = camera.rotation @ known[:3], camera.rotation @ known[3:] * extent
        delta = rigid.exponential(jnp.concatenate([rotation, translation]))
        return replace(camera, cam_from_world=delta @ camera.cam_from_world)

    def update(
        self,
        state: PerPhoto,
        source: Source,
        gradient: Float[Array, "6"],
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> PerPhoto:
        """The state after a step of a run that has so many."""
        rate = rate_for(self.reach, steps / len(state.visits), progress)
        state = per_photo.moved(state, source.view, gradient, rate)
        return replace(state, values=per_photo.centred(state.values))


class Learned(NamedTuple):
    """Of poses and lenses: their tables, or what is known of one photo's."""

    poses: Any
    focals: Any


@dataclass(frozen=True)
class PosesAndFocal:
    """Poses, and a factor on the focal lengths of each lens. Photos share a lens if their cameras were
    given the same numbers."""

    poses: Poses = Poses()
    reach: float = 0.02  # how far the factor can go from 1 in a whole run

    def init(self, photos: int) -> Learned:
        """As given: a row has the logarithm of a factor. There are at most as many lenses as photos."""
        return Learned(self.poses.init(photos), per_photo.zeros(photos, 1))

    def of(self, state: Learned, source: Source) -> Learned:
        """The twist and the logarithm of the factor of a photo's camera."""
        return Learned(self.poses.of(state.poses, source), state.focals.values[source.lens])

    def __call__(self, known: Learned, camera: Camera, extent: Float[Array, ""]) -> Camera:
        """The camera as it is now thought to be."""
        factor = jnp.exp(known.focals[0])
        zoomed = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
        return self.poses(known.poses, zoomed, extent)

    def update(
        self,
        state: Learned,
        source: Source,
        gradient: Learned,
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> Learned:
        """The state after a step of a run that has so many."""
        lenses = jnp.maximum(jnp.sum(state.focals.visits > 0), 1)  # after the first epoch, all
        rate = rate_for(self.reach, steps / lenses, progress)
        return Learned(
            self.poses.update(state.poses, source, gradient.poses, progress, steps),
            per_photo.moved(state.focals, source.lens, gradient.focals, rate),
        )


CameraRefinement = FixedCameras | Poses | PosesAndFocal
CAMERA_REFINEMENTS: dict[str, CameraRefinement] = {
    "none": FixedCameras(),
    "poses": Poses(),
    "poses+focal": PosesAndFocal(),
}


def rate_for(reach: float, visits: Float[Array, ""] | float, progress: Float[Array, ""]) -> Float[Array, ""]:
    """Of Adam, so that the steps of all visits together are as long as `reach`."""
    mean = (1 - FALL) / -math.log(FALL)  # of the rates over the run, to the first
    return per_photo.falling(1.0, FALL, progress) * (reach / (mean * visits))


def refined(
    refinement: CameraRefinement, state: Any, views: tuple[View, ...], extent: Float[Array, ""]
) -> tuple[View, ...]:
    """The training views of a run with their cameras as they are now thought to be.

    Args:
        refinement: of the recipe.
        state: what the run has learned of the cameras.
        views: that it is trained on, in the same order.
        extent: of the scene, world units.
    """
    known: list[Any] = [refinement.of(state, source) for source in sources(views)]
    return tuple(
        replace(view, camera=refinement(of_view, view.camera, extent))
        for view, of_view in zip(views, known, strict=True)
    )
