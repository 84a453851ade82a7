"""Lenses that bundle adjustment can change, as COLMAP has them, and what it found for photos of any size."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera
from splatax.cameras.conventions import COLMAP_MODELS, from_colmap, to_colmap
from splatax.cameras.rig import numbers_of_lenses
from splatax.dataset import View

if TYPE_CHECKING:
    import pycolmap

# What bundle adjustment may change; the lens is focal lengths and distortion.
Free = Literal["poses", "poses+focal", "poses+distortion", "poses+lens"]
FOCAL, DISTORTION = ("poses+focal", "poses+lens"), ("poses+distortion", "poses+lens")
ADJUSTMENTS: tuple[str, ...] = get_args(Free)
OF_OPENCV = ("PINHOLE", "FULL_OPENCV")  # COLMAP's models for lenses of OpenCV's


@dataclass(frozen=True)
class Correction:
    """A lens after bundle adjustment, apart from the size of photos.

    Attributes:
        focal: factors on the given focal lengths fx and fy.
        model: COLMAP's name of the lens.
        coefficients: the model's parameters after focal lengths and principal point.
    """

    focal: tuple[float, float]
    model: str
    coefficients: tuple[float, ...]

    def __call__(self, camera: Camera) -> Camera:
        """Returns a given camera with this lens; its principal point, pose and motion stay."""
        dtype = camera.fx.dtype
        fx, fy = (
            jnp.asarray(np.float64(given) * factor, dtype)
            for given, factor in zip((camera.fx, camera.fy), self.focal, strict=True)
        )
        affine = [1.0] * COLMAP_MODELS[self.model].focals + [0.0, 0.0]
        like = from_colmap(self.model, [*affine, *self.coefficients], 1, 1, camera.cam_from_world)
        return replace(camera, fx=fx, fy=fy, lens=jax.tree.map(lambda leaf: leaf.astype(dtype), like.lens))


def adjustable(camera: Camera, free: Free) -> "pycolmap.Camera":
    """Returns COLMAP's camera with the parameters that may change, and as few others as possible.

    Equal focal lengths stay equal, unless the lens has more coefficients than k1 and k2.

    Args:
        camera: a camera whose lens COLMAP has; its motion is left out.
        free: the parameters that may change.
    """
    import pycolmap

    model, numbers = to_colmap(replace(camera, motion=None))
    if model in OF_OPENCV and free != "poses":
        affine, k = numbers[:4], (*numbers[4:], *[0.0] * 8)[:8]
        square, straight = affine[0] == affine[1], free == "poses+focal" and not any(k)
        if square and straight:
            model, numbers = "SIMPLE_PINHOLE", affine[1:]
        elif straight:
            model, numbers = "PINHOLE", affine
        elif square and not any(k[2:]):
            model, numbers = "RADIAL", [*affine[1:], *k[:2]]
        elif not any(k[4:]):
            model, numbers = "OPENCV", [*affine, *k[:4]]
        else:
            model, numbers = "FULL_OPENCV", [*affine, *k]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=numbers)


def correction_to(given: "pycolmap.Camera", found: "pycolmap.Camera") -> Correction:
    """Returns the correction of a camera that bundle adjustment has changed."""
    factors = (
        found.focal_length_x / given.focal_length_x,
        found.focal_length_y / given.focal_length_y,
    )
    coefficients = tuple(float(found.params[i]) for i in found.extra_params_idxs())
    return Correction(factors, found.model.name, coefficients)


def known_to_colmap(camera: Camera) -> bool:
    """Returns whether COLMAP has the lens of a camera."""
    try:
        to_colmap(replace(camera, motion=None))
    except ValueError:
        return False
    return True


def alike(
    given: Sequence[View], corrections: Mapping[str, Correction], others: Sequence[View]
) -> dict[str, Correction]:
    """Returns the corrections, by name, of views taken through the same lenses as views that have some.

    Args:
        given: views before their correction.
        corrections: by the names of these views.
        others: views of the same capture, before any correction.
    """
    numbers = numbers_of_lenses([view.camera for view in (*given, *others)])
    known = {
        number: corrections[view.name]
        for number, view in zip(numbers, given, strict=False)
        if view.name in corrections
    }
    return {
        view.name: known[number]
        for number, view in zip(numbers[len(given) :], others, strict=True)
        if number in known
    }


def corrected(views: Sequence[View], corrections: Mapping[str, Correction]) -> tuple[View, ...]:
    """Returns views with the corrections that there are for their names."""
    return tuple(
        replace(view, camera=corrections[view.name](view.camera)) if view.name in corrections else view
        for view in views
    )
