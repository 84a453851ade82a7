"""The stages of the pipeline by given kernels: what traced code calls. Nothing here looks a backend up."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax import along_rays, cameras
from splatax import splats as views
from splatax.backends.protocol import Kernels, Selection
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays, LowPass
from splatax.projection import in_order
from splatax.scene import Drawable, seen
from splatax.shapes import check_dtypes
from splatax.splats import Splats
from splatax.varying import vary_together


def project(
    scene: Drawable, camera: Camera, low_pass: LowPass | None, kernels: Kernels, projection: Method = EWA
) -> Splats:
    """Projects a scene, as `splatax.project` does.

    Raises:
        ValueError: if the shapes or dtypes of the arrays do not fit together.
    """
    scene = seen.checked(scene)
    cameras.checked(camera)
    check_dtypes("Gaussians and Camera", {**seen.means_of(scene), "cam_from_world": camera.cam_from_world})
    return _project(scene, camera, low_pass, kernels, projection)


@partial(jax.jit, static_argnames=("low_pass", "kernels", "method"))
def _project(
    scene: Drawable, camera: Camera, low_pass: LowPass | None, kernels: Kernels, method: Method
) -> Splats:
    scene, camera = vary_together(scene, camera)
    return views.joined(
        [
            _projected(gaussians, own, low_pass or gaussians.low_pass, kernels, method)
            for gaussians, own in seen.seen_from(scene, camera)
        ]
    )


def _projected(
    gaussians: Gaussians, camera: Camera, low_pass: LowPass, kernels: Kernels, method: Method
) -> Splats:
    """Projects Gaussians. Those that are drawn along rays are projected in the same way for all backends."""
    if isinstance(low_pass, AlongRays):
        splats = along_rays.project(gaussians, camera, low_pass, method)
    else:
        splats = kernels.project(gaussians, camera, low_pass, method)
    return in_order(splats, gaussians, camera)


def draw(
    scene: Drawable,
    camera: Camera,
    depths: bool,
    low_pass: LowPass | None,
    kernels: Kernels,
    projection: Method,
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]] | None:
    """Projects and blends colours at once, where the backend has a kernel for it.

    Args:
        scene: a checked scene.
        camera: the view.
        depths: whether depths are blended too, as a fourth channel.
        low_pass: see `render`.
        kernels: the backend.
        projection: see `render`.

    Returns:
        The sums over splats of weight times channel, and alpha; None if the backend has no such kernel for
        this scene and camera.

    Raises:
        ValueError: if the camera is malformed.
    """
    if not isinstance(scene, Gaussians) or len(scene) == 0:
        return None
    low_pass = low_pass or scene.low_pass
    if isinstance(low_pass, AlongRays):
        return None
    cameras.checked(camera)
    check_dtypes("Gaussians and Camera", {"means": scene.means, "cam_from_world": camera.cam_from_world})
    if kernels.at_once(camera, projection) is None:
        return None
    return _draw(scene, camera, depths, low_pass, kernels, projection)


@partial(jax.jit, static_argnames=("depths", "low_pass", "kernels", "projection"))
def _draw(
    scene: Gaussians, camera: Camera, depths: bool, low_pass: LowPass, kernels: Kernels, projection: Method
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    kernel = kernels.at_once(camera, projection)
    assert kernel is not None
    scene, camera = vary_together(scene, camera)
    return kernel(scene, camera, low_pass, depths)


def select(splats: Splats, count: int, kernels: Kernels) -> Selection:
    """Finds the splats that decide each pixel, as `splatax.rendering.select` does.

    Raises:
        ValueError: if the arrays do not fit together.
    """
    views.checked(splats)
    size, n = (splats.height, splats.width), splats.means2d.shape[0]
    if n == 0:
        none = jnp.full((*size, count), -1, jnp.int32)
        return Selection(none, none.astype(splats.means2d.dtype) * 0, jnp.full(size, -1, jnp.int32))
    return _select(jax.lax.stop_gradient(splats), count, kernels)


@partial(jax.jit, static_argnames=("count", "kernels"))
def _select(splats: Splats, count: int, kernels: Kernels) -> Selection:
    (splats,) = vary_together(splats)
    n = splats.means2d.shape[0]
    found = kernels.select(views.unrolled(views.for_kernels(splats), splats.colors)[0], count)
    if splats.period is None:
        return found

    def row(indices):  # a copy on the other side of the seam stands for its splat
        return jnp.where(indices >= n, indices - n, indices)

    return Selection(row(found.indices), found.weights, row(found.median))


def composite(
    splats: Splats, channels: Float[Array, "n c"], kernels: Kernels
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends channels into every pixel, as `splatax.composite` does.

    Raises:
        ValueError: if the shapes or dtypes of the arrays do not fit together, or the kernels cannot give the
            gradient of `pull` for so many channels.
    """
    views.checked(splats, channels)
    if splats.means2d.shape[0] == 0:
        size, dtype = (splats.height, splats.width), splats.means2d.dtype
        return jnp.zeros((*size, channels.shape[1]), dtype), jnp.zeros(size, dtype)
    return _composite(splats, channels, kernels)


@partial(jax.jit, static_argnames="kernels")
def _composite(splats: Splats, channels: Float[Array, "n c"], kernels: Kernels):
    splats, channels = vary_together(splats, channels)
    return kernels.composite(*views.unrolled(views.for_kernels(splats), channels))
