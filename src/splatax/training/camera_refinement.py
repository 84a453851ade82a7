"""Corrections of the training cameras, learned together with the scene."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from splatax.cameras import Camera, RollingShutter
from splatax.cameras.lenses import Equirectangular, OpenCV, Orthographic, Pinhole, opencv
from splatax.dataset import View
from splatax.errors import InputError
from splatax.math import rigid
from splatax.pytrees import pytree
from splatax.training import per_photo
from splatax.training.feed import sources
from splatax.training.per_photo import NoParameters, PerPhoto, PerView
from splatax.training.protocols import CameraRefinement, Source

MANY = 12  # photos from which the common part of their twists includes what is linear in their places
FLAT = 1e-3  # relative variance of the places in a direction, below which they count as equal in it
FINAL_RATE = 0.01  # learning rate at the end, as a fraction of that at the start (as in gsplat)


@dataclass(frozen=True)
class FixedCameras(NoParameters):
    """Keeps the cameras as they were given."""

    def __call__(self, parameters: tuple[()], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Returns the camera unchanged."""
        return camera


@pytree
@dataclass(frozen=True)
class Placed(PerPhoto):
    """A table of parameters of photos, with the places where they were taken.

    Attributes:
        places: optical centres as given, world units; zero before the first step of a photo.
    """

    places: Float[Array, "photos 3"]


@dataclass(frozen=True)
class Poses(PerView):
    """Learns a twist for each training camera, multiplied to `cam_from_world` from the left.

    A twist turns a camera about its own centre and translates it. Its six numbers are along the axes of the
    world, in radians and extents of the scene. All cameras can turn, move and grow together with the scene
    without changing any rendering (gauge freedom), and bend together almost without changing any. The scene
    then leaves the held-out cameras, so the twists have neither a mean nor a part that is linear in the place
    of the camera. With fewer photos than `MANY`, only the mean is held at zero. An error that all given poses
    share remains. Fixing one camera instead would propagate its error to the others.
    """

    WIDTH: ClassVar[int] = 6  # a rotation and a translation
    reach: float = 0.02  # length of all steps of a camera in a run together: radians, extents of the scene
    longest: float = 0.15  # longest step, pixels of the photo; longer ones throw right poses off

    def init(self, photos: int) -> Placed:
        """Returns the table before the first step."""
        table = per_photo.zeros(photos, self.WIDTH)
        return Placed(table.values, table.opt_state, jnp.zeros((photos, 3)))

    @jax.default_matmul_precision("highest")
    def __call__(self, parameters: Float[Array, "6"], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Applies a twist to a camera."""
        rotation, translation = camera.rotation @ parameters[:3], camera.rotation @ parameters[3:] * extent
        delta = rigid.exponential(jnp.concatenate([rotation, translation]))
        return replace(camera, cam_from_world=delta @ camera.cam_from_world)

    def update(
        self,
        state: Placed,
        source: Source,
        gradient: Float[Array, "6"],
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> Placed:
        """Makes one step for one camera, then removes what the cameras have in common."""
        rate = rate_for(self.reach, steps / len(state.visits), progress)
        rate = jnp.minimum(rate, self.longest * source.pixel * fall(progress))
        state = per_photo.updated(state, source.view, gradient, rate)
        state = replace(state, places=state.places.at[source.view].set(source.place))
        return replace(state, values=unshared(state))


class PerLens:
    """Learns numbers of each lens. Two photos have the same lens if all but their poses is equal."""

    WIDTH: ClassVar[int]  # how many numbers a lens has
    reach: float  # length of all steps of each number in a run together

    def init(self, photos: int) -> PerPhoto:
        """Returns lenses as given: all numbers are zero. There are at most as many lenses as photos."""
        return per_photo.zeros(photos, self.WIDTH)

    def for_photo(self, state: PerPhoto, source: Source) -> Float[Array, " width"]:
        """Returns the numbers of the lens of one photo."""
        return state.values[source.lens]

    def update(
        self,
        state: PerPhoto,
        source: Source,
        gradient: Float[Array, " width"],
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> PerPhoto:
        """Makes one step for one lens."""
        lenses = jnp.maximum(jnp.sum(state.visits > 0), 1)  # all of them after the first epoch
        return per_photo.updated(state, source.lens, gradient, rate_for(self.reach, steps / lenses, progress))


@dataclass(frozen=True)
class Focal(PerLens):
    """Learns the logarithm of a factor on both focal lengths of each lens."""

    WIDTH: ClassVar[int] = 1
    reach: float = 0.02

    def __call__(self, parameters: Float[Array, "1"], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Multiplies the focal lengths of a camera."""
        factor = jnp.exp(parameters[0])
        return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


@dataclass(frozen=True)
class Distortion(PerLens):
    """Learns the coefficients of each lens; a pinhole becomes a lens of OpenCV's model.

    Of OpenCV's coefficients k1, k2, p1 and p2 are learned, and those others that are not zero; all of other
    lenses. High powers that start at zero would fit the noise at the corners.
    """

    WIDTH: ClassVar[int] = 12  # the most that a lens has
    reach: float = 0.2

    def __call__(self, parameters: Float[Array, "12"], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Adds to the coefficients of a camera's lens."""
        lens = opencv(dtype=camera.fx.dtype) if isinstance(camera.lens, Pinhole) else camera.lens
        given, rebuild = ravel_pytree(lens)
        free = jnp.ones_like(given)
        if isinstance(lens, OpenCV):
            first = OpenCV(jnp.array([1.0, 1, 0, 0, 0, 0]), jnp.ones(2), jnp.zeros(4))
            free = jnp.maximum(ravel_pytree(first)[0], jnp.where(given == 0, 0.0, 1.0))
        return replace(camera, lens=rebuild(given + free * parameters[: given.size]))


@dataclass(frozen=True)
class Shutter(PerView):
    """Learns the motion of each training camera during its exposure: a rolling shutter that goes downwards.

    The six numbers are those of `RollingShutter.twist`, with the translation in extents of the scene.
    """

    WIDTH: ClassVar[int] = 6
    reach: float = 0.02  # length of all steps of a camera in a run together: radians, extents of the scene

    def __call__(self, parameters: Float[Array, "6"], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Adds the motion to a camera, and to the motion that it was given with."""
        motion = camera.motion or RollingShutter(jnp.zeros_like(parameters))
        twist = jnp.concatenate([parameters[:3], parameters[3:] * extent])
        return replace(camera, motion=replace(motion, twist=motion.twist + twist))

    def update(
        self,
        state: PerPhoto,
        source: Source,
        gradient: Float[Array, "6"],
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> PerPhoto:
        """Makes one step for one camera."""
        rate = rate_for(self.reach, steps / len(state.visits), progress)
        return per_photo.updated(state, source.view, gradient, rate)


@dataclass(frozen=True)
class Together:
    """Learns several corrections, which are applied one after the other."""

    parts: tuple[CameraRefinement, ...]

    def init(self, photos: int) -> tuple[Any, ...]:
        """Returns the states of the parts."""
        return tuple(part.init(photos) for part in self.parts)

    def for_photo(self, state: tuple[Any, ...], source: Source) -> tuple[Any, ...]:
        """Returns the parameters of one photo's camera, for each part."""
        return tuple(part.for_photo(own, source) for part, own in zip(self.parts, state, strict=True))

    def __call__(self, parameters: tuple[Any, ...], camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Applies all corrections to a camera."""
        for part, own in zip(self.parts, parameters, strict=True):
            camera = part(own, camera, extent)
        return camera

    def update(
        self,
        state: tuple[Any, ...],
        source: Source,
        gradient: tuple[Any, ...],
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> tuple[Any, ...]:
        """Makes one step of every part."""
        return tuple(
            part.update(own, source, slope, progress, steps)
            for part, own, slope in zip(self.parts, state, gradient, strict=True)
        )


CAMERA_REFINEMENTS: dict[str, CameraRefinement] = {
    "none": FixedCameras(),
    "poses": Poses(),
    "focal": Focal(),
    "poses+focal": Together((Focal(), Poses())),
    "lens": Together((Distortion(), Focal())),
    "poses+lens": Together((Distortion(), Focal(), Poses())),
    "shutter": Shutter(),
    "poses+shutter": Together((Shutter(), Poses())),
}


def check_lenses(name: str, views: Sequence[View]) -> None:
    """Refuses a refinement that the lenses of the photos do not allow.

    Args:
        name: of the refinement, in `CAMERA_REFINEMENTS`.
        views: the training views.

    Raises:
        InputError: if a lens has nothing to learn, or the files of the result cannot hold it.
    """
    fixed = Orthographic if name in ("poses", "shutter", "poses+shutter") else Orthographic | Equirectangular
    for view in views:
        if isinstance(view.camera.lens, fixed):
            raise InputError(
                f"{view.name} has the lens {type(view.camera.lens).__name__}, for which {name} cannot be "
                "refined. Leave the cameras as they are.",
                options=("refine",),
            )


def rate_for(reach: float, visits: Float[Array, ""] | float, progress: Float[Array, ""]) -> Float[Array, ""]:
    """Returns Adam's learning rate such that the steps of all visits together are `reach` long."""
    mean = (1 - FINAL_RATE) / -math.log(FINAL_RATE)  # of the rates over the run, as a fraction of the first
    return fall(progress) * (reach / (mean * visits))


@jax.default_matmul_precision("highest")
def unshared(table: Placed) -> Float[Array, "photos 6"]:
    """Returns the twists without their mean and, of many photos, without their part linear in the places."""
    values = per_photo.centred(table.values)
    if len(values) < MANY:
        return values
    seen = (table.visits > 0).astype(values.dtype)[:, None]
    count = jnp.maximum(jnp.sum(seen), 1)
    offsets = seen * (table.places - jnp.sum(seen * table.places, axis=0, keepdims=True) / count)
    offsets = offsets / jnp.sqrt(jnp.maximum(jnp.sum(offsets * offsets) / count, 1e-20))
    moments = offsets.T @ offsets + FLAT * count * jnp.eye(3)
    return values - offsets @ jnp.linalg.solve(moments, offsets.T @ values)


def fall(progress: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the learning rate as a fraction of that at the start."""
    return per_photo.log_linear(1.0, FINAL_RATE, progress)


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
