"""EWA projection by the native library; see `splatax.backends.pinholes` for its derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Array

from splatax.backends.cpu.library import Build
from splatax.backends.foreign import Shape
from splatax.backends.pinholes import Options


@dataclass(frozen=True)
class NativeProjection:
    """The library's projection and its gradient, which take batches of cameras."""

    build: Build
    shares_scenes: ClassVar[bool] = True

    def forward(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the arrays of `Splats`."""
        return self.build.call("splatax_project_forward", shapes, arrays, batches=True, **options)

    def gradient(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the gradients of the scene and the camera."""
        return self.build.call("splatax_project_backward", shapes, arrays, batches=True, **options)
