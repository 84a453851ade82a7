"""Projection by kernels that know only pinholes: how a camera is packed for them, and what they compute.

The kernels serve cameras that do not move, by EWA; the portable projection serves all others.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.cameras.lenses import Pinhole
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.projection import project_one

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
PackedCamera = Float[Array, "19"]  # fx, fy, cx, cy, rotation by rows, translation, position


def serves(camera: Camera, method: Method) -> bool:
    """Returns whether the kernels know a camera and a way to find footprints."""
    return isinstance(camera.lens, Pinhole) and camera.motion is None and method == EWA


def arrays_of(gaussians: Gaussians) -> tuple[Array, ...]:
    """Returns the arrays of a scene in the order of the kernels."""
    return tuple(getattr(gaussians, field) for field in FIELDS)


def packed(camera: Camera) -> PackedCamera:
    """Returns the numbers of a camera as one array, as `CameraField` in native/ orders them."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    return jnp.concatenate(
        [jnp.stack(numbers), jnp.ravel(camera.rotation), camera.translation, camera.position]
    )


def project(
    size: tuple[int, int], low_pass: LowPass, arrays: tuple[Array, ...], camera: PackedCamera
) -> tuple[Array, ...]:
    """Returns what the kernels do, by plain JAX: the arrays of `Splats` in their order.

    Args:
        size: width and height of the image, pixels.
        low_pass: filter against aliasing.
        arrays: of the scene.
        camera: packed.
    """
    fx, fy, cx, cy = camera[:4]
    pose = jnp.eye(4, dtype=camera.dtype).at[:3, :3].set(camera[4:13].reshape(3, 3))
    view = Camera(fx, fy, cx, cy, pose.at[:3, 3].set(camera[13:16]), *size)
    one = partial(project_one, camera=view, position=camera[16:], low_pass=low_pass, method=EWA)
    rows = jax.vmap(lambda *fields: one(*fields))(*arrays)
    return tuple(rows._replace(extent=jax.lax.stop_gradient(rows.extent)))


def shown(extents: Float[Array, "*c n 2"], arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """Returns arrays of splats with zeros where the splats are culled."""
    drawn = extents[..., :1] > 0
    return tuple(
        jnp.where(drawn if array.ndim == drawn.ndim else drawn[..., 0], array, 0) for array in arrays
    )
