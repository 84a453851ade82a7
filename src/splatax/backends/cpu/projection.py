"""EWA projection by the native library; see `splatax.backends.projection_kernels` for its derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Array

from splatax.backends.cpu.library import Build
from splatax.backends.foreign import Shape
from splatax.backends.projection_kernels import Options, ProjectionKernels
from splatax.cameras.lenses import Fisheye, OpenCV, Pinhole

LENSES = (Pinhole, OpenCV, Fisheye)  # as `LensKind` in native/ orders them


@dataclass(frozen=True)
class NativeProjection:
    """The library's projection and its derivatives, which take batches of cameras and of directions.

    Attributes:
        build: the library.
        lens: kind of lens, by its place in `LENSES`.
    """

    build: Build
    lens: int
    shares_scenes: ClassVar[bool] = True

    def forward(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the arrays of `Splats`."""
        return self._call("splatax_project_forward", shapes, arrays, options)

    def gradient(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the gradients of the scene and the camera."""
        return self._call("splatax_project_backward", shapes, arrays, options)

    def tangent(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the tangents of the splats."""
        return self._call("splatax_project_tangent", shapes, arrays, options)

    def _call(
        self, symbol: str, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options
    ) -> Sequence[Array]:
        lens = np.int64(self.lens)
        return self.build.call(symbol, shapes, arrays, batches=True, aliases=None, lens=lens, **options)


def projections(build: Build) -> ProjectionKernels:
    """Returns the projections of a build, by kind of lens."""
    return {lens: NativeProjection(build, place) for place, lens in enumerate(LENSES)}
