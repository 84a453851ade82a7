"""Corrections of the training cameras, learned together with the scene."""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.dataset import View
from splatax.math import rigid
from splatax.training import per_photo
from splatax.training.feed import sources
from splatax.training.per_photo import NoParameters, PerPhoto
from splatax.training.protocols import CameraRefinement, Source

FINAL_RATE = 0.01  # learning rate at the end, as a fraction of that at the start (as in gsplat)


@dataclass(frozen=True)
class FixedCameras(NoParameters):
    """Keeps the cameras as they were given."""

    def __call__(self, parameters: tuple[()], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Returns the camera unchanged."""
        return camera


@dataclass(frozen=True)
class Poses:
    """Learns a twist for each training camera, multiplied to `cam_from_world` from the left.

    A twist turns a camera about its own centre and translates it. Its six numbers are along the axes of
    the world, in radians and extents of the scene. All cameras can turn and move together with the scene
    without changing any rendering (gauge freedom), so the mean twist over the photos is held at zero.
    This distributes the common error of the given poses evenly; fixing one camera instead would make the
    others follow the error of that camera.
    """

    reach: float = 0.02  # length of all steps of a camera in a run together: radians, extents of the scene

    def init(self, photos: int) -> PerPhoto:
        """Returns the cameras as given: a row holds a rotation and a translation, all zero."""
        return per_photo.zeros(photos, 6)

    def for_photo(self, state: PerPhoto, source: Source) -> Float[Array, "6"]:
        """Returns the twist of one photo's camera."""
        return state.values[source.view]

    @jax.default_matmul_precision("highest")
    def __call__(self, parameters: Float[Array, "6"], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Applies a twist to a camera."""
        rotation, translation = camera.rotation @ parameters[:3], camera.rotation @ parameters[3:] * extent
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
        """Makes one step for one camera, then restores the mean twist to zero."""
        rate = rate_for(self.reach, steps / len(state.visits), progress)
        state = per_photo.updated(state, source.view, gradient, rate)
        return replace(state, values=per_photo.centred(state.values))


class PosesAndLenses(NamedTuple):
    """Parameters of poses and lenses: the tables of a run, or the values for one photo."""

    poses: Any
    focals: Any


@dataclass(frozen=True)
class PosesAndFocal:
    """Learns poses, and a factor on the focal lengths of each lens.

    Two photos have the same lens if the intrinsics and sizes of their cameras are equal.
    """

    poses: Poses = Poses()
    reach: float = 0.02  # length of all steps of the factor's logarithm in a run together

    def init(self, photos: int) -> PosesAndLenses:
        """Returns cameras as given; a row for a lens holds the logarithm of its factor.

        There are at most as many lenses as photos.
        """
        return PosesAndLenses(self.poses.init(photos), per_photo.zeros(photos, 1))

    def for_photo(self, state: PosesAndLenses, source: Source) -> PosesAndLenses:
        """Returns the twist and the logarithm of the factor for one photo's camera."""
        return PosesAndLenses(self.poses.for_photo(state.poses, source), state.focals.values[source.lens])

    def __call__(self, parameters: PosesAndLenses, camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Applies a factor on the focal lengths and a twist to a camera."""
        factor = jnp.exp(parameters.focals[0])
        zoomed = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
        return self.poses(parameters.poses, zoomed, extent)

    def update(
        self,
        state: PosesAndLenses,
        source: Source,
        gradient: PosesAndLenses,
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> PosesAndLenses:
        """Makes one step for one camera and its lens."""
        lenses = jnp.maximum(jnp.sum(state.focals.visits > 0), 1)  # all of them after the first epoch
        rate = rate_for(self.reach, steps / lenses, progress)
        return PosesAndLenses(
            self.poses.update(state.poses, source, gradient.poses, progress, steps),
            per_photo.updated(state.focals, source.lens, gradient.focals, rate),
        )


CAMERA_REFINEMENTS: dict[str, CameraRefinement] = {
    "none": FixedCameras(),
    "poses": Poses(),
    "poses+focal": PosesAndFocal(),
}


def rate_for(reach: float, visits: Float[Array, ""] | float, progress: Float[Array, ""]) -> Float[Array, ""]:
    """Returns Adam's learning rate such that the steps of all visits together are `reach` long."""
    mean = (1 - FINAL_RATE) / -math.log(FINAL_RATE)  # of the rates over the run, as a fraction of the first
    return per_photo.log_linear(1.0, FINAL_RATE, progress) * (reach / (mean * visits))


def refined(
    refinement: CameraRefinement, state: Any, views: tuple[View, ...], extent: Float[Array, ""]
) -> tuple[View, ...]:
    """Returns the training views of a run with their corrected cameras.

    Args:
        refinement: of the recipe.
        state: of the refinement, from the run.
        views: the training views of the run, in the same order.
        extent: of the scene, world units.
    """
    corrections = [refinement.for_photo(state, source) for source in sources(views)]
    return tuple(
        replace(view, camera=refinement(correction, view.camera, extent))
        for view, correction in zip(views, corrections, strict=True)
    )
