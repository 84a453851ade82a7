"""render = rasterize . project: from a scene and a camera to a picture.

The functions here are the door of the engine. They check shapes and dtypes and resolve the backend once, so
that kernels get nothing that is malformed.
"""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import backends, cameras
from splatax import gaussians as scenes
from splatax import splats as views
from splatax.backends.protocol import Kernels
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.shapes import check_arrays, check_dtypes
from splatax.splats import Splats
from splatax.varying import vary_together

BLACK = np.zeros(3, np.float32)
WHITE = np.ones(3, np.float32)

BackgroundArray = Float[Array, "3"] | Float[Array, "h w 3"]
BackgroundLike = (
    tuple[float, float, float] | BackgroundArray | Float[np.ndarray, "3"] | Float[np.ndarray, "h w 3"]
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rendering:
    """Rendered image of one view.

    Attributes:
        rgb: display-referred colour over the background, at least 0; may exceed 1.
        alpha: coverage of the pixel, in [0, 1].
        depth: mean camera z of the splats that cover the pixel, world units; 0 if none does.
        features: extra channels, weighted like colour, without a background.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    features: Float[Array, "h w f"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Renderer:
    """The settings of `render` as one value, which evaluation, viewers and reports carry.

    It is a pytree, so it passes through `jit`. `Renderer()(scene, camera)` is `render(scene, camera)`.

    Attributes:
        background: RGB seen through what transmittance remains, one colour or one for each pixel. Traced.
        low_pass: filter, such as `Antialiasing(0.3)`; None for the one that the scene was trained
            with. Static.
        backend: "auto", the name of a backend, or kernels of your own. Static.
        projection: `Ewa()` or `Unscented()`. Static.
    """

    background: BackgroundLike = (0.0, 0.0, 0.0)
    low_pass: LowPass | None = field(default=None, metadata={"static": True})
    backend: str | Kernels = field(default=backends.AUTO, metadata={"static": True})
    projection: Method = field(default=EWA, metadata={"static": True})

    def __call__(
        self, gaussians: Gaussians, camera: Camera, features: Float[Array, "n f"] | None = None
    ) -> Rendering:
        """Renders a scene; see `render`."""
        scenes.checked(gaussians)
        kernels = backends.resolve(self.backend, _dtype(gaussians.means))
        splats = project(
            gaussians, camera, low_pass=self.low_pass, backend=kernels, projection=self.projection
        )
        return rasterize(splats, background=self.background, features=features, backend=kernels)


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: BackgroundLike = BLACK,
    features: Float[Array, "n f"] | None = None,
    low_pass: LowPass | None = None,
    backend: str | Kernels = backends.AUTO,
    projection: Method = EWA,
) -> Rendering:
    """Renders a scene. Differentiable in all arrays: scene, camera, background and features.

    Args:
        gaussians: the scene.
        camera: the view; its width and height are static under `jit`. For several views, use `jax.vmap`.
        background: RGB seen through what transmittance remains, one colour or one for each pixel.
        features: extra channels for each Gaussian, rendered beside colour.
        low_pass: filter, such as `Antialiasing(0.3)`; None for the one that the scene was trained with.
        backend: "auto", the name of a backend, or kernels of your own.
        projection: how a Gaussian's image is found, `Ewa()` or `Unscented()`; see `splatax.footprints`.

    Raises:
        ValueError: if the shapes or dtypes of the arrays do not fit together, or the backend is unknown or
            not available here.
    """
    return Renderer(background, low_pass, backend, projection)(gaussians, camera, features)


def project(
    gaussians: Gaussians,
    camera: Camera,
    *,
    low_pass: LowPass | None = None,
    backend: str | Kernels = backends.AUTO,
    projection: Method = EWA,
) -> Splats:
    """Projects a scene: the first half of `render`. Differentiable in the scene and the camera.

    Culled rows have zero extent: those that the lens does not see (nearer than 0.01, or behind a pinhole),
    more transparent than 1/255, beside the image, or with a number that is not finite. They get a zero
    gradient, and leave that of the camera finite.

    Args:
        gaussians: the scene.
        camera: the view.
        low_pass: see `render`.
        backend: see `render`.
        projection: see `render`.

    Returns:
        The 2D Gaussians that the camera sees, one row for each Gaussian, in the same order.

    Raises:
        ValueError: as `render`.
    """
    scenes.checked(gaussians)
    cameras.checked(camera)
    dtype = check_dtypes(
        "Gaussians and Camera", {"means": gaussians.means, "cam_from_world": camera.cam_from_world}
    )
    kernels = backends.resolve(backend, dtype)
    return _project(gaussians, camera, low_pass or gaussians.low_pass, kernels, projection)


@partial(jax.jit, static_argnames=("low_pass", "kernels", "method"))
def _project(
    gaussians: Gaussians, camera: Camera, low_pass: LowPass, kernels: Kernels, method: Method
) -> Splats:
    gaussians, camera = vary_together(gaussians, camera)
    return kernels.project(gaussians, camera, low_pass, method)


def rasterize(
    splats: Splats,
    *,
    background: BackgroundLike = BLACK,
    features: Float[Array, "n f"] | None = None,
    backend: str | Kernels = backends.AUTO,
) -> Rendering:
    """Draws the 2D Gaussians of one view: the second half of `render`.

    Raises:
        ValueError: as `render`.
    """
    views.checked(splats)
    if features is None:
        features = jnp.zeros((splats.means2d.shape[0], 0), splats.means2d.dtype)
    check_arrays("Splats", {"means2d": (splats.means2d, "n 2"), "features": (features, "n f")})
    behind = jnp.asarray(background, splats.means2d.dtype)
    if behind.shape not in ((3,), (splats.height, splats.width, 3)):
        raise ValueError(
            f"background has shape {behind.shape}. Give one colour, (3,), or one for each pixel, "
            f"{(splats.height, splats.width, 3)}."
        )
    return _rasterize(splats, behind, features, backends.resolve(backend, _dtype(splats.means2d)))


@partial(jax.jit, static_argnames="kernels")
def _rasterize(
    splats: Splats,
    background: BackgroundArray,
    features: Float[Array, "n f"],
    kernels: Kernels,
) -> Rendering:
    channels = {"rgb": splats.colors, "depth": splats.depths[:, None], "features": features}
    widths = np.cumsum([channel.shape[1] for channel in channels.values()])
    blended, alpha = composite(splats, jnp.concatenate(list(channels.values()), axis=1), backend=kernels)
    sums = dict(zip(channels, jnp.split(blended, widths[:-1], axis=2), strict=True))
    covered = alpha > 0
    return Rendering(
        rgb=over(sums["rgb"], alpha, background),
        alpha=alpha,
        depth=jnp.where(covered, sums["depth"][..., 0] / jnp.where(covered, alpha, 1), 0),
        features=sums["features"],
    )


def composite(
    splats: Splats, channels: Float[Array, "n c"], *, backend: str | Kernels = backends.AUTO
) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
    """Blends any per-splat channels front to back into every pixel.

    Differentiable in means2d, sqrt_conics, opacities and channels. The order of depths is not differentiable;
    to render depth, pass it as a channel. Splats with `pull` get its gradient too.

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
    kernels = backends.resolve(backend, _dtype(splats.means2d))
    if splats.means2d.shape[0] == 0:
        size, dtype = (splats.height, splats.width), splats.means2d.dtype
        return jnp.zeros((*size, channels.shape[1]), dtype), jnp.zeros(size, dtype)
    return _composite(splats, channels, kernels)


@partial(jax.jit, static_argnames="kernels")
def _composite(splats: Splats, channels: Float[Array, "n c"], kernels: Kernels):
    splats, channels = vary_together(splats, channels)
    return kernels.composite(*views.unrolled(splats, channels))


def over(
    premultiplied: Float[Array, "h w 3"],
    alpha: Float[Array, "h w"],
    background: BackgroundArray,
) -> Float[Array, "h w 3"]:
    """Returns colour that is already weighted by alpha, over a background."""
    behind = background[None, None, :] if background.ndim == 1 else background
    return premultiplied + (1 - alpha)[..., None] * behind


def _dtype(array: Array | np.ndarray) -> np.dtype:
    """Returns the dtype that JAX computes in for an array: without x64, float64 becomes float32."""
    return jax.dtypes.canonicalize_dtype(array.dtype)
