"""EWA projection by the native library; see `splatax.projection` for what it computes."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.camera import Camera
from splatax.gaussians import Gaussians
from splatax.native import Build
from splatax.splats import Splats

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True)
class Settings:
    """What is static in a projection.

    Attributes:
        build: of the library.
        width, height: of the image, pixels.
        variance: of the low-pass, pixels^2.
        floor: least factor on opacity; 1 leaves it as it is.
    """

    build: Build
    width: int
    height: int
    variance: float
    floor: float

    def options(self) -> dict[str, np.int64 | np.float32]:
        return {
            "width": np.int64(self.width),
            "height": np.int64(self.height),
            "variance": np.float32(self.variance),
            "floor": np.float32(self.floor),
        }


def project(gaussians: Gaussians, camera: Camera, build: Build, variance: float, floor: float) -> Splats:
    """The 2D Gaussians that a camera sees. Differentiable in the Gaussians and the camera."""
    settings = Settings(build, camera.width, camera.height, variance, floor)
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
    splats = settings.build.call("splatax_project", shapes, (*arrays, camera), **settings.options())
    return tuple(splats), (arrays, camera, splats[3])


def _backward(settings: Settings, residuals, cotangents):
    arrays, camera, extents = residuals
    d_means2d, d_sqrt_conics, d_depths, _, d_colors, d_opacities = cotangents
    inputs = (*arrays, camera, extents, d_means2d, d_sqrt_conics, d_depths, d_colors, d_opacities)
    shapes = [array.shape for array in (*arrays, camera)]
    *d_arrays, d_camera = settings.build.call(
        "splatax_project_gradient", shapes, inputs, **settings.options()
    )
    return tuple(d_arrays), d_camera


_project.defvjp(_forward, _backward)
