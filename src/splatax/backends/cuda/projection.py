"""EWA projection on the GPU; see `splatax.backends.projection_kernels` for its derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Array

from splatax.backends.cuda.library import Library
from splatax.backends.foreign import Shape
from splatax.backends.projection_kernels import Options


@dataclass(frozen=True)
class GpuProjection:
    """The GPU's projection and its gradient, which `jax.vmap` calls once for each camera."""

    library: Library
    shares_scenes: ClassVar[bool] = False

    def forward(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the arrays of `Splats`."""
        return self.library.call("splatax_cuda_project", shapes, arrays, **options)

    def gradient(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the gradients of the scene and the camera."""
        return self.library.call("splatax_cuda_project_gradient", shapes, arrays, **options)

    def tangent(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> None:
        """Returns None: plain JAX finds tangents."""
