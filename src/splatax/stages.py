"""The stages of rendering, with the checks that kernels rely on: `project`, `composite`, `select`."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import along_rays, backends, cameras
from splatax import splats as views
from splatax.backends.protocol import MOST_SELECTED, Kernels, Selection
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays, LowPass
from splatax.scene import Drawable, seen
from splatax.shapes import check_dtypes
from splatax.splats import Splats
from splatax.varying import vary_together


def project(
    scene: Drawable,
    camera: Camera,
    *,
    low_pass: LowPass | None = None,
    backend: str | Kernels = backends.AUTO,
    projection: Method = EWA,
) -> Splats:
    """Projects a scene: the first half of `render`. Differentiable in the scene and the camera.

    Culled rows have zero extent: those that the lens does not see (nearer than 0.01, or behind a pinhole),
    more transparent than 1/255, beside the image, of a hidden part, or with a number that is not finite. They
    get a zero gradient, and leave that of the camera and of the poses finite. Their other numbers are finite,
    and only the depths have a meaning.

    Args:
        scene: Gaussians, or a `Scene` of parts.
        camera: the view.
        low_pass: see `render`.
        backend: see `render`.
        projection: see `render`.

    Returns:
        The 2D Gaussians that the camera sees, one row for each Gaussian, in the same order.

    Raises:
        ValueError: as `render`.
    """
    scene = seen.checked(scene)
    cameras.checked(camera)
    dtype = check_dtypes(
        "Gaussians and Camera", {**seen.means_of(scene), "cam_from_world": camera.cam_from_world}
    )
    return _project(scene, camera, low_pass, backends.resolve(backend, dtype), projection)


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


def _projected(
    gaussians: Gaussians, camera: Camera, low_pass: LowPass, kernels: Kernels, method: Method
) -> Splats:
    """Projects Gaussians. Those that are drawn along rays are projected in the same way for all backends."""
    if isinstance(low_pass, AlongRays):
        return along_rays.project(gaussians, camera, low_pass, method)
    return kernels.project(gaussians, camera, low_pass, method)


def select(splats: Splats, count: int, *, backend: str | Kernels = backends.AUTO) -> Selection:
    """Finds the splats that contribute most to each pixel, and the one that makes it half opaque.

    The result has no gradient.

    Args:
        splats: the 2D Gaussians of one view.
        count: how many splats to find for each pixel, 0 to 64.
        backend: see `render`.

    Raises:
        ValueError: if the number is out of range, the arrays do not fit together, or the backend is unknown
            or not available here.
    """
    views.checked(splats)
    if not 0 <= count <= MOST_SELECTED:
        raise ValueError(f"count is {count}, but `select` finds 0 to {MOST_SELECTED} splats for each pixel.")
    kernels = backends.resolve(backend, dtype_of(splats.means2d))
    size, n = (splats.height, splats.width), splats.means2d.shape[0]
    if n == 0:
        none = jnp.full((*size, count), -1, jnp.int32)
        return Selection(none, none.astype(splats.means2d.dtype) * 0, jnp.full(size, -1, jnp.int32))
    return _select(jax.lax.stop_gradient(splats), count, kernels)


@partial(jax.jit, static_argnames=("count", "kernels"))
def _select(splats: Splats, count: int, kernels: Kernels) -> Selection:
    (splats,) = vary_together(splats)
    n = splats.means2d.shape[0]
    found = kernels.select(views.unrolled(splats, splats.colors)[0], count)
    if splats.period is None:
        return found

    def row(indices):  # a copy on the other side of the seam stands for its splat
        return jnp.where(indices >= n, indices - n, indices)

    return Selection(row(found.indices), found.weights, row(found.median))


def composite(
    splats: Splats, channels: Float[Array, "n c"], *, backend: str | Kernels = backends.AUTO
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends any per-splat channels front to back into every pixel.

    Differentiable in means2d, sqrt_conics, opacities, slants and channels. The order of depths is not
    differentiable; to render depth, pass it as a channel. Splats with `pull` get its gradient too.

    Args:
        splats: their `colors` are not used: pass them as channels.
        channels: what to blend, any number of them.
        backend: see `render`.

    Returns:
        The sums over splats of weight times channel, and the sums of weights (alpha).

    Raises:
        ValueError: if the shapes or dtypes of the arrays do not fit together, or the backend is unknown, not
            available here, or cannot give the gradient of `pull` for so many channels.
    """
    views.checked(splats, channels)
    kernels = backends.resolve(backend, dtype_of(splats.means2d))
    if splats.means2d.shape[0] == 0:
        size, dtype = (splats.height, splats.width), splats.means2d.dtype
        return jnp.zeros((*size, channels.shape[1]), dtype), jnp.zeros(size, dtype)
    return _composite(splats, channels, kernels)


@partial(jax.jit, static_argnames="kernels")
def _composite(splats: Splats, channels: Float[Array, "n c"], kernels: Kernels):
    splats, channels = vary_together(splats, channels)
    return kernels.composite(*views.unrolled(splats, channels))


def dtype_of(array: Array | np.ndarray) -> np.dtype:
    """Returns the dtype that JAX computes in for an array: without x64, float64 becomes float32."""
    return jax.dtypes.canonicalize_dtype(array.dtype)
