"""EWA projection on the GPU; see `splatax.projection` for what it computes."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import projection
from splatax.backends.cuda.library import Library
from splatax.backends.linear import Dims, linear_call
from splatax.cameras import Camera
from splatax.cameras.lenses import Pinhole
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.projection import project_one
from splatax.splats import Splats

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


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

    The kernels know pinholes that do not move, by EWA; the portable projection does all others.
    """
    if not (isinstance(camera.lens, Pinhole) and camera.motion is None and method == EWA):
        return projection.project(gaussians, camera, low_pass, method)
    settings = Settings(library, camera.width, camera.height, low_pass)
    numbers = [
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.rotation,
        camera.translation,
        camera.position,
    ]
    packed = jnp.concatenate([jnp.ravel(number) for number in numbers])  # as CameraField in native/
    arrays = tuple(getattr(gaussians, field) for field in FIELDS)
    means2d, sqrt_conics, depths, extents, colors, opacities = _project(arrays, packed, settings)
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


def _portable(settings: Settings, arrays: tuple[Array, ...], camera: Float[Array, "19"]) -> tuple[Array, ...]:
    """Returns what `_project` does, by plain JAX."""
    fx, fy, cx, cy = camera[:4]
    pose = jnp.eye(4, dtype=camera.dtype).at[:3, :3].set(camera[4:13].reshape(3, 3))
    view = Camera(fx, fy, cx, cy, pose.at[:3, 3].set(camera[13:16]), settings.width, settings.height)

    def one(mean, quat, log_scale, logit, sh):
        return project_one(mean, quat, log_scale, logit, sh, view, camera[16:], settings.low_pass, EWA)

    rows = jax.vmap(one)(*arrays)
    return tuple(rows._replace(extent=jax.lax.stop_gradient(rows.extent)))


def _shown(extents: Float[Array, "n 2"], found: tuple[Array, ...]) -> tuple[Array, ...]:
    """Returns arrays of the splats with zeros where they are culled."""
    shown = extents[:, :1] > 0
    return tuple(jnp.where(shown if array.ndim == 2 else shown[:, 0], array, 0) for array in found)


@dataclass(frozen=True)
class Derivative:
    """The derivative of the projection: backward on the GPU, forward by the portable kernel."""

    settings: Settings

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats."""
        arrays, camera, extents = residuals
        _, found = jax.jvp(partial(_portable, self.settings), (arrays, camera), (tangents[:5], tangents[5]))
        return _shown(extents, found)

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
        d_arrays, d_camera = jax.vjp(partial(_portable, settings), arrays, camera)[1](
            _shown(extents, cotangents)
        )
        return (*d_arrays, d_camera)

    _, out = jax.jvp(gradient, (arrays, camera, cotangents), (d_arrays, d_camera, d_cotangents))
    return _pull_back(*primals, settings), out
