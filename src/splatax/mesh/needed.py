"""The packages that make meshes, which splatax needs for nothing else."""

from collections.abc import Callable
from typing import Any, NamedTuple

from splatax.packages import required_by


class Needed(NamedTuple):
    """Functions of other packages.

    Attributes:
        marching_cubes: of scikit-image (BSD licence).
        simplify: of fast-simplification (MIT licence).
    """

    marching_cubes: Callable[..., Any]
    simplify: Callable[..., Any]


def needed() -> Needed:
    """Imports the packages that make meshes.

    Raises:
        MissingPackageError: if one is not installed.
    """
    with required_by("splatax.mesh"):
        from fast_simplification import simplify
        from skimage.measure import marching_cubes
    return Needed(marching_cubes, simplify)
