"""EWA projection on the GPU; see `splatax.projection` for what it computes."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.cuda.library import Library
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.splats import Splats

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True)
class Settings:
    """The static settings of a projection.

    Attributes:
        library: the handlers and their device.
        width, height: of the image, pixels.
        variance: of the low-pass, pixels^2.
        least_fade: the least factor that the low-pass may multiply opacity by; None if it leaves opacity.
    """

    library: Library
    width: int
    height: int
    variance: float
    least_fade: float | None

    def call(self, symbol: str, shapes: list[tuple[int, ...]], arrays: tuple[Array, ...]) -> list[Array]:
        """Calls a handler with these settings."""
        results = self.library.call(
            symbol,
            shapes,
            arrays,
            width=np.int64(self.width),
            height=np.int64(self.height),
            variance=np.float32(self.variance),
            fades=np.int64(self.least_fade is not None),
            least_fade=np.float32(self.least_fade or 0),
        )
        return list(results)


def project(gaussians: Gaussians, camera: Camera, low_pass: LowPass, library: Library) -> Splats:
    """Projects all Gaussians to one view. Differentiable in the Gaussians and the camera."""
    least_fade = low_pass.floor if isinstance(low_pass, Antialiasing) else None
    settings = Settings(library, camera.width, camera.height, low_pass.variance, least_fade)
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


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _project(arrays: tuple[Array, ...], camera: Float[Array, "19"], settings: Settings):
    return _forward(arrays, camera, settings)[0]


def _forward(arrays: tuple[Array, ...], camera: Float[Array, "19"], settings: Settings):
    n = len(arrays[0])
    shapes = [(n, 2), (n, 3), (n,), (n, 2), (n, 3), (n,)]
    splats = settings.call("splatax_cuda_project", shapes, (*arrays, camera))
    return tuple(splats), (arrays, camera, splats[3])


def _backward(settings: Settings, residuals, cotangents):
    arrays, camera, extents = residuals
    d_means2d, d_sqrt_conics, d_depths, _, d_colors, d_opacities = cotangents
    inputs = (*arrays, camera, extents, d_means2d, d_sqrt_conics, d_depths, d_colors, d_opacities)
    shapes = [array.shape for array in (*arrays, camera)]
    *d_arrays, d_camera = settings.call("splatax_cuda_project_gradient", shapes, inputs)
    return tuple(d_arrays), d_camera


_project.defvjp(_forward, _backward)
