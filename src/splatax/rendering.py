"""render = rasterize . project: from a scene and a camera to a picture.

The functions here are the door of the engine. They check shapes and dtypes and resolve the backend once, so
that kernels get nothing that is malformed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import backends, cameras
from splatax import gaussians as scenes
from splatax import splats as views
from splatax.backends.protocol import MOST_SELECTED, Kernels, Selection
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.outputs import STANDARD, BackgroundArray, Drawn, Output, Outputs, Rendering, Seen, resolve
from splatax.shapes import check_arrays, check_dtypes
from splatax.splats import Splats
from splatax.varying import vary_together

BLACK = np.zeros(3, np.float32)
WHITE = np.ones(3, np.float32)

Features = Mapping[str, Float[Array, "n _"]]
BackgroundLike = (
    tuple[float, float, float] | BackgroundArray | Float[np.ndarray, "3"] | Float[np.ndarray, "h w 3"]
)


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
    """

    background: BackgroundLike = (0.0, 0.0, 0.0)
    low_pass: LowPass | None = field(default=None, metadata={"static": True})
    backend: str | Kernels = field(default=backends.AUTO, metadata={"static": True})

    def __call__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        outputs: Outputs = STANDARD,
        features: Features | None = None,
    ) -> Rendering:
        """Renders a scene; see `render`."""
        requested = resolve(outputs)
        scenes.checked(gaussians)
        kernels = backends.resolve(self.backend, _dtype(gaussians.means))
        splats = project(gaussians, camera, low_pass=self.low_pass, backend=kernels)
        seen = Seen(splats, gaussians, camera)
        return _draw(seen, self.background, features or {}, requested, kernels)


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    outputs: Outputs = STANDARD,
    features: Features | None = None,
    background: BackgroundLike = BLACK,
    low_pass: LowPass | None = None,
    backend: str | Kernels = backends.AUTO,
) -> Rendering:
    """Renders a scene. Differentiable in all arrays: scene, camera, background and features.

    The outputs "rgb", "alpha", "depth", "distance" and the features have exact derivatives. "median_depth"
    has the derivative of the one depth that it shows. "contributors" has none.

    Args:
        gaussians: the scene.
        camera: the view; its width and height are static under `jit`. For several views, use `jax.vmap`.
        outputs: what to render: names from `splatax.outputs.OUTPUTS`, or a mapping from names to outputs of
            your own. Outputs that are not requested are not computed.
        features: further numbers of each Gaussian by name, such as {"labels": [n 24]}. They are blended like
            colour, without a background, and returned under the same names.
        background: RGB seen through what transmittance remains, one colour or one for each pixel.
        low_pass: filter, such as `Antialiasing(0.3)`; None for the one that the scene was trained with.
        backend: "auto", the name of a backend, or kernels of your own.

    Raises:
        ValueError: if the shapes or dtypes of the arrays do not fit together, an output is unknown, or the
            backend is unknown or not available here.
    """
    return Renderer(background, low_pass, backend)(gaussians, camera, outputs, features)


def project(
    gaussians: Gaussians,
    camera: Camera,
    *,
    low_pass: LowPass | None = None,
    backend: str | Kernels = backends.AUTO,
) -> Splats:
    """Projects a scene: the first half of `render`. Differentiable in the scene and the camera.

    Culled rows have zero extent: those nearer than 0.01, more transparent than 1/255, beside the image, or
    with a number that is not finite. They get a zero gradient, and leave that of the camera finite.

    Args:
        gaussians: the scene.
        camera: the view.
        low_pass: see `render`.
        backend: see `render`.

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
    return _project(gaussians, camera, low_pass or gaussians.low_pass, backends.resolve(backend, dtype))


@partial(jax.jit, static_argnames=("low_pass", "kernels"))
def _project(gaussians: Gaussians, camera: Camera, low_pass: LowPass, kernels: Kernels) -> Splats:
    gaussians, camera = vary_together(gaussians, camera)
    return kernels.project(gaussians, camera, low_pass)


def rasterize(
    splats: Splats,
    *,
    outputs: Outputs = STANDARD,
    features: Features | None = None,
    background: BackgroundLike = BLACK,
    backend: str | Kernels = backends.AUTO,
) -> Rendering:
    """Draws the 2D Gaussians of one view: the second half of `render`.

    Raises:
        ValueError: as `render`; also for the output "distance", which splats alone do not determine.
    """
    requested = resolve(outputs)
    views.checked(splats)
    kernels = backends.resolve(backend, _dtype(splats.means2d))
    return _draw(Seen(splats, None, None), background, features or {}, requested, kernels)


def _draw(
    seen: Seen,
    background: BackgroundLike,
    features: Features,
    requested: tuple[tuple[str, Output], ...],
    kernels: Kernels,
) -> Rendering:
    """Checks background and features, and draws them with the requested outputs."""
    splats = seen.splats
    named = {f"features[{name!r}]": (values, "n f") for name, values in features.items()}
    for name, values in named.items():  # each has a width of its own
        check_arrays("Splats", {"means2d": (splats.means2d, "n 2"), name: values})
    behind = jnp.asarray(background, splats.means2d.dtype)
    if behind.shape not in ((3,), (splats.height, splats.width, 3)):
        raise ValueError(
            f"background has shape {behind.shape}. Give one colour, (3,), or one for each pixel, "
            f"{(splats.height, splats.width, 3)}."
        )
    return _finish(seen, behind, dict(features), requested, kernels)


@partial(jax.jit, static_argnames=("requested", "kernels"))
def _finish(
    seen: Seen,
    background: BackgroundArray,
    features: Features,
    requested: tuple[tuple[str, Output], ...],
    kernels: Kernels,
) -> Rendering:
    seen, background, features = vary_together(seen, background, features)
    splats = seen.splats
    channels = {("image", name): output.channels(seen) for name, output in requested if output.channels}
    channels |= {("feature", name): values for name, values in features.items()}
    sums: dict[tuple[str, str], Array] = {}
    alpha = selection = None
    if channels:
        widths = np.cumsum([values.shape[1] for values in channels.values()])
        blended, alpha = composite(splats, jnp.concatenate(list(channels.values()), axis=1), backend=kernels)
        sums = dict(zip(channels, jnp.split(blended, widths[:-1], axis=2), strict=True))
    counts = [output.selected for _, output in requested if output.selected is not None]
    if counts:
        selection = select(splats, max(counts), backend=kernels)

    def drawn(name: str, output: Output) -> Drawn:
        count = output.selected
        own = None
        if selection is not None and count is not None:
            own = Selection(selection.indices[..., :count], selection.weights[..., :count], selection.median)
        return Drawn(sums.get(("image", name)), alpha, own, splats, background)

    return Rendering(
        images={name: output.finish(drawn(name, output)) for name, output in requested},
        features={name: sums["feature", name] for name in features},
    )


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
    kernels = backends.resolve(backend, _dtype(splats.means2d))
    size, n = (splats.height, splats.width), splats.means2d.shape[0]
    if n == 0:
        none = jnp.full((*size, count), -1, jnp.int32)
        return Selection(none, none.astype(splats.means2d.dtype) * 0, jnp.full(size, -1, jnp.int32))
    return _select(jax.lax.stop_gradient(splats), count, kernels)


@partial(jax.jit, static_argnames=("count", "kernels"))
def _select(splats: Splats, count: int, kernels: Kernels) -> Selection:
    (splats,) = vary_together(splats)
    return kernels.select(splats, count)


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
    return kernels.composite(splats, channels)


def _dtype(array: Array | np.ndarray) -> np.dtype:
    """Returns the dtype that JAX computes in for an array: without x64, float64 becomes float32."""
    return jax.dtypes.canonicalize_dtype(array.dtype)
