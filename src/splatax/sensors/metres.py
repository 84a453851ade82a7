"""The scale of a scene: how many metres one world unit has, as its file keeps it."""

from pathlib import Path

import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io import formats
from splatax.io.formats.marks import metres_in, metres_mark
from splatax.transforms import Similarity


def in_metres(metres_per_unit: float) -> Similarity:
    """Returns the transform from a scene's units to metres, for its Gaussians and its cameras.

    Raises:
        ValueError: if the number is not finite and above zero.
    """
    return Similarity(np.eye(3), np.zeros(3), metres_per_unit)


def load_in_metres(path: str | Path) -> Gaussians:
    """Reads a splat file whose scale is known, and returns the scene in metres.

    Cameras of its capture fit the scene after `in_metres(scale).transform_camera(camera)`.

    Raises:
        FormatError: if the file keeps no scale, and in the cases of `splatax.load`.
    """
    gaussians = formats.load(path)
    scale = metres_of(path)
    if scale is None:
        raise FormatError(
            f"{path}: keeps no scale, so it is not known how long its unit is. Measure a known distance in "
            "it (splatax metres), or scale the scene yourself with in_metres."
        )
    return in_metres(scale).transform(gaussians)


def metres_of(path: str | Path) -> float | None:
    """Returns how many metres one unit of a scene has, as its file keeps it; None if it does not.

    Raises:
        FormatError: if the file is damaged, or keeps something other than a number above zero.
    """
    comments = formats.comments(path)
    try:
        return metres_in(comments)
    except ValueError as error:
        raise FormatError(
            f"{path}: its scale is damaged ({error}). Measure it again: splatax metres."
        ) from error


def kept_metres(path: str | Path, scale: float = 1.0) -> tuple[str, ...]:
    """Returns the comment with the metres of a scene, for a copy of it; nothing if its file keeps none.

    Args:
        path: file of the scene.
        scale: factor by which the copy is scaled.

    Raises:
        FormatError: as `metres_of`.
    """
    metres = metres_of(path)
    return () if metres is None else (metres_mark(metres / scale),)
