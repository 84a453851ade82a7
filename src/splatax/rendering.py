"""render = rasterize . project: from a scene and a camera to a picture."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import rasterizers
from splatax.camera import Camera
from splatax.gaussians import Gaussians
from splatax.projection import Dilation, LowPass, project
from splatax.splats import Splats

BLACK = np.zeros(3, np.float32)
WHITE = np.ones(3, np.float32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rendering:
    """What a camera sees.

    Attributes:
        rgb: display-referred colour over the background, at least 0; may exceed 1.
        alpha: how much of the pixel is covered, in [0, 1].
        depth: mean camera z of what covers the pixel, world units; 0 where nothing does.
        features: the extra channels, weighted like colour, over nothing.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    features: Float[Array, "h w f"]


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Array, "3"] | Float[np.ndarray, "3"] = BLACK,
    features: Float[Array, "n f"] | None = None,
    low_pass: LowPass = Dilation(),
    backend: str = rasterizers.AUTO,
) -> Rendering:
    """Renders a scene. Differentiable in all arrays: scene, camera, background and features.

    Args:
        gaussians: the scene.
        camera: the view; its width and height are static under `jit`.
        background: RGB seen through what transmittance remains.
        features: extra channels for each Gaussian, rendered beside colour.
        low_pass: `Dilation(0.3)`, or `Antialiasing(0.3)` for scenes trained so.
        backend: "auto", or the name of a rasterizer.

    Raises:
        ValueError: if the backend is unknown or not available here.
    """
    splats = project(gaussians, camera, low_pass=low_pass, backend=backend)
    return rasterize(splats, background=background, features=features, backend=backend)


def rasterize(
    splats: Splats,
    *,
    background: Float[Array, "3"] | Float[np.ndarray, "3"] = BLACK,
    features: Float[Array, "n f"] | None = None,
    backend: str = rasterizers.AUTO,
) -> Rendering:
    """The second half of `render`: draws the 2D Gaussians of one view."""
    if features is None:
        features = jnp.zeros((splats.means2d.shape[0], 0), splats.means2d.dtype)
    background = jnp.asarray(background, splats.means2d.dtype)
    return _rasterize(splats, background, features, rasterizers.resolve(backend, splats.means2d.dtype))


@partial(jax.jit, static_argnames="backend")
def _rasterize(
    splats: Splats, background: Float[Array, "3"], features: Float[Array, "n f"], backend: str
) -> Rendering:
    channels = jnp.concatenate([splats.colors, splats.depths[:, None], features], axis=1)
    sums, alpha = rasterizers.composite(splats, channels, backend=backend)
    covered = alpha > 0
    return Rendering(
        rgb=over(sums[..., :3], alpha, background),
        alpha=alpha,
        depth=jnp.where(covered, sums[..., 3] / jnp.where(covered, alpha, 1), 0),
        features=sums[..., 4:],
    )


def over(
    premultiplied: Float[Array, "h w 3"], alpha: Float[Array, "h w"], background: Float[Array, "3"]
) -> Float[Array, "h w 3"]:
    """Colour that is already weighted by alpha, over a background."""
    return premultiplied + (1 - alpha)[..., None] * background[None, None, :]
