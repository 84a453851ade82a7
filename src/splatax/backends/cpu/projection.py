"""EWA projection by the native library; see `splatax.projection` for what it computes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import projection
from splatax.backends import pinholes
from splatax.backends.cpu.library import Build
from splatax.backends.linear import Batched, Dims, linear_call
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.splats import Splats


@dataclass(frozen=True)
class Settings:
    """The static settings of a projection.

    Attributes:
        build: the build of the library to call.
        width, height: of the image, pixels.
        low_pass: the filter.
    """

    build: Build
    width: int
    height: int
    low_pass: LowPass

    @property
    def portable(self) -> Callable[[tuple[Array, ...], Array], tuple[Array, ...]]:
        """The computation of the kernels, by plain JAX."""
        return partial(pinholes.project, (self.width, self.height), self.low_pass)

    def options(self) -> dict[str, np.int64 | np.float32]:
        """Returns the attributes of the native call."""
        fades = isinstance(self.low_pass, Antialiasing)
        return {
            "width": np.int64(self.width),
            "height": np.int64(self.height),
            "variance": np.float32(self.low_pass.variance),
            "fades": np.int64(fades),
            "least_fade": np.float32(self.low_pass.floor if isinstance(self.low_pass, Antialiasing) else 0),
        }


def project(
    gaussians: Gaussians, camera: Camera, low_pass: LowPass, method: Method = EWA, *, build: Build
) -> Splats:
    """Projects all Gaussians to one view. Differentiable in the Gaussians and the camera.

    The library knows what `pinholes.serves`; the portable projection does all else.
    """
    if not pinholes.serves(camera, method):
        return projection.project(gaussians, camera, low_pass, method)
    settings = Settings(build, camera.width, camera.height, low_pass)
    splats = _project(pinholes.arrays_of(gaussians), pinholes.packed(camera), settings)
    means2d, sqrt_conics, depths, extents, colors, opacities = splats
    return Splats(means2d, sqrt_conics, depths, extents, colors, opacities, camera.width, camera.height)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _project(arrays: tuple[Array, ...], camera: Float[Array, "19"], settings: Settings) -> tuple[Array, ...]:
    n = len(arrays[0])
    shapes = [(n, 2), (n, 3), (n,), (n, 2), (n, 3), (n,)]
    return tuple(
        settings.build.call(
            "splatax_project_forward", shapes, (*arrays, camera), batches=True, **settings.options()
        )
    )


@_project.defjvp
def _(settings: Settings, primals, tangents):
    arrays, camera = primals
    splats = _project(arrays, camera, settings)
    directions = (*tangents[0], tangents[1])
    return splats, linear_call(Derivative(settings), (arrays, camera, splats[3]), directions, splats)


@dataclass(frozen=True)
class Derivative:
    """The derivative of the native projection: backward native, forward by the portable kernel."""

    settings: Settings

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats."""
        arrays, camera, extents = residuals
        _, found = jax.jvp(self.settings.portable, (arrays, camera), (tangents[:5], tangents[5]))
        return pinholes.shown(extents, found)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the Gaussians' arrays and of the camera."""
        return tuple(_pull_back(residuals, cotangents, self.settings))

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> "SharedScene | None":
        """Returns the map of a batch of cameras that share a scene; None for other batches."""
        scene = (None,) * 5
        if residuals == (*scene, 0, 0) and tangents[:5] == scene:
            return SharedScene(self.settings, Batched(self, RESIDUALS, residuals, tangents))
        return None


@dataclass(frozen=True)
class SharedScene:
    """The derivative of a batch of cameras that share a scene, whose gradient is summed in the native call.

    Attributes:
        settings: of each projection.
        each: the same derivative, camera by camera.
    """

    settings: Settings
    each: Batched

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats of all cameras."""
        return self.each.apply(residuals, tangents)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the scene, summed over the cameras, and that of the cameras."""
        arrays, camera, extents = residuals
        leading = tuple(array[None] for array in arrays)
        *scene, d_camera = _pull_back((leading, camera, extents), cotangents, self.settings)
        if self.each.tangents[5] is None:
            d_camera = jnp.sum(d_camera, axis=0)
        return (*(array[0] for array in scene), d_camera)

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> Batched:
        """Returns the map that `jax.vmap` makes of the same derivative, camera by camera."""
        return Batched(self.each, RESIDUALS, residuals, tangents)


RESIDUALS = jax.tree.structure(((0,) * 5, 0, 0))


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _pull_back(residuals, cotangents: tuple[Array, ...], settings: Settings) -> tuple[Array, ...]:
    """Returns the gradients; those of a scene with a leading axis of 1 are summed over the cameras."""
    arrays, camera, extents = residuals
    d_means2d, d_sqrt_conics, d_depths, _, d_colors, d_opacities = cotangents
    inputs = (*arrays, camera, extents, d_means2d, d_sqrt_conics, d_depths, d_colors, d_opacities)
    shapes = [array.shape for array in (*arrays, camera)]
    return tuple(
        settings.build.call("splatax_project_backward", shapes, inputs, batches=True, **settings.options())
    )


@_pull_back.defjvp
def _(settings: Settings, primals, tangents):
    # Second derivatives come from the portable kernel, which JAX differentiates.
    (arrays, camera, extents), cotangents = primals
    (d_arrays, d_camera, _), d_cotangents = tangents

    def gradient(arrays, camera, cotangents):
        if extents.ndim == 3:  # cameras that share a scene

            def all_splats(arrays, camera):
                scene = tuple(array[0] for array in arrays)
                return jax.vmap(settings.portable, (None, 0))(scene, camera)

        else:
            all_splats = settings.portable
        d_arrays, d_camera = jax.vjp(all_splats, arrays, camera)[1](pinholes.shown(extents, cotangents))
        return (*d_arrays, d_camera)

    _, out = jax.jvp(gradient, (arrays, camera, cotangents), (d_arrays, d_camera, d_cotangents))
    return _pull_back(*primals, settings), out
