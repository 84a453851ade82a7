"""EWA projection on the GPU; see `splatax.projection` for what it computes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from splatax import projection
from splatax.backends import pinholes
from splatax.backends.cuda.library import Library
from splatax.backends.linear import Dims, linear_call
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.splats import Splats


@dataclass(frozen=True)
class Settings:
    """The static settings of a projection.

    Attributes:
        library: the handlers and their device.
        width, height: of the image, pixels.
        low_pass: the filter.
    """

    library: Library
    width: int
    height: int
    low_pass: LowPass

    @property
    def portable(self) -> Callable[[tuple[Array, ...], Array], tuple[Array, ...]]:
        """The computation of the kernels, by plain JAX."""
        return partial(pinholes.project, (self.width, self.height), self.low_pass)

    def call(self, symbol: str, shapes: list[tuple[int, ...]], arrays: tuple[Array, ...]) -> list[Array]:
        """Calls a handler with these settings."""
        fades = isinstance(self.low_pass, Antialiasing)
        results = self.library.call(
            symbol,
            shapes,
            arrays,
            width=np.int64(self.width),
            height=np.int64(self.height),
            variance=np.float32(self.low_pass.variance),
            fades=np.int64(fades),
            least_fade=np.float32(self.low_pass.floor if isinstance(self.low_pass, Antialiasing) else 0),
        )
        return list(results)


def project(
    gaussians: Gaussians, camera: Camera, low_pass: LowPass, method: Method = EWA, *, library: Library
) -> Splats:
    """Projects all Gaussians to one view. Differentiable in the Gaussians and the camera.

    The kernels know what `pinholes.serves`; the portable projection does all else.
    """
    if not pinholes.serves(camera, method):
        return projection.project(gaussians, camera, low_pass, method)
    settings = Settings(library, camera.width, camera.height, low_pass)
    splats = _project(pinholes.arrays_of(gaussians), pinholes.packed(camera), settings)
    means2d, sqrt_conics, depths, extents, colors, opacities = splats
    return Splats(means2d, sqrt_conics, depths, extents, colors, opacities, camera.width, camera.height)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _project(arrays: tuple[Array, ...], camera: Float[Array, "19"], settings: Settings) -> tuple[Array, ...]:
    n = len(arrays[0])
    shapes = [(n, 2), (n, 3), (n,), (n, 2), (n, 3), (n,)]
    return tuple(settings.call("splatax_cuda_project", shapes, (*arrays, camera)))


@_project.defjvp
def _(settings: Settings, primals, tangents):
    arrays, camera = primals
    splats = _project(arrays, camera, settings)
    directions = (*tangents[0], tangents[1])
    return splats, linear_call(Derivative(settings), (arrays, camera, splats[3]), directions, splats)


@dataclass(frozen=True)
class Derivative:
    """The derivative of the projection: backward on the GPU, forward by the portable kernel."""

    settings: Settings

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats."""
        arrays, camera, extents = residuals
        _, found = jax.jvp(self.settings.portable, (arrays, camera), (tangents[:5], tangents[5]))
        return pinholes.shown(extents, found)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the Gaussians' arrays and of the camera."""
        return _pull_back(residuals, cotangents, self.settings)

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> None:
        """Returns None: `jax.vmap` calls the derivative once for each element."""


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _pull_back(residuals, cotangents: tuple[Array, ...], settings: Settings) -> tuple[Array, ...]:
    arrays, camera, extents = residuals
    d_means2d, d_sqrt_conics, d_depths, _, d_colors, d_opacities = cotangents
    inputs = (*arrays, camera, extents, d_means2d, d_sqrt_conics, d_depths, d_colors, d_opacities)
    shapes = [array.shape for array in (*arrays, camera)]
    return tuple(settings.call("splatax_cuda_project_gradient", shapes, inputs))


@_pull_back.defjvp
def _(settings: Settings, primals, tangents):
    # Second derivatives come from the portable kernel, which JAX differentiates.
    (arrays, camera, extents), cotangents = primals
    (d_arrays, d_camera, _), d_cotangents = tangents

    def gradient(arrays, camera, cotangents):
        d_arrays, d_camera = jax.vjp(settings.portable, arrays, camera)[1](
            pinholes.shown(extents, cotangents)
        )
        return (*d_arrays, d_camera)

    _, out = jax.jvp(gradient, (arrays, camera, cotangents), (d_arrays, d_camera, d_cotangents))
    return _pull_back(*primals, settings), out
