"""The stages of rendering for callers that name a backend: `project`, `composite`, `select`.

Each looks its backend up, outside `jit`, and passes the kernels on to `pipeline`.
"""

import jax
import numpy as np
from jaxtyping import Array, Float

from splatax import backends, pipeline
from splatax import splats as views
from splatax.backends.protocol import MOST_SELECTED, Kernels, Selection
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.low_pass import LowPass
from splatax.scene import Drawable, seen
from splatax.shapes import check_kind
from splatax.splats import Splats


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
        TypeError: as `render`.
        ValueError: as `render`.
    """
    check_manner(low_pass, projection)
    scene = seen.checked(scene)
    first, *_ = seen.means_of(scene).values()
    return pipeline.project(scene, camera, low_pass, backends.resolve(backend, dtype_of(first)), projection)


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
    return pipeline.select(splats, count, backends.resolve(backend, dtype_of(splats.means2d)))


def composite(
    splats: Splats, channels: Float[Array, "n c"], *, backend: str | Kernels = backends.AUTO
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends any per-splat channels front to back into every pixel.

    Differentiable in means2d, sqrt_conics, opacities, slants and channels. The order of the splats is not
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
    return pipeline.composite(splats, channels, backends.resolve(backend, dtype_of(splats.means2d)))


def check_manner(low_pass: LowPass | None, projection: Method) -> None:
    """Checks that a filter and a way to project are such.

    Raises:
        TypeError: if one is of another kind, such as its name.
    """
    check_kind("low_pass", low_pass, LowPass | None, "Give a filter, such as splatax.Antialiasing().")
    check_kind("projection", projection, Method, "Give Ewa() or Unscented() of splatax.footprints.")


def dtype_of(array: Array | np.ndarray) -> np.dtype:
    """Returns the dtype that JAX computes in for an array: without x64, float64 becomes float32."""
    return jax.dtypes.canonicalize_dtype(array.dtype)
