"""render = rasterize . project: from a scene and a camera to a picture.

The functions here are the public entry points. They check shapes and dtypes, so that kernels never get
malformed arrays, and look the backend up once. What they trace gets its kernels, and cannot look one up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import backends, pipeline
from splatax import splats as views
from splatax.backends.protocol import Kernels, Selection
from splatax.cameras import Camera
from splatax.cameras.geometry import rays
from splatax.drawn import unrolled
from splatax.footprints import EWA, Method
from splatax.low_pass import LowPass
from splatax.outputs import (
    OUTPUTS,
    STANDARD,
    BackgroundArray,
    Drawn,
    Output,
    Outputs,
    Rendering,
    Seen,
    resolve,
)
from splatax.pytrees import pytree
from splatax.scene import Drawable, seen
from splatax.shapes import check_arrays
from splatax.sky import Surroundings
from splatax.splats import Splats
from splatax.stages import check_manner, dtype_of
from splatax.stages import composite as composite
from splatax.stages import project as project
from splatax.stages import select as select
from splatax.varying import vary_together

BLACK = np.zeros(3, np.float32)
WHITE = np.ones(3, np.float32)
BLENDED = tuple(OUTPUTS[name] for name in ("rgb", "alpha", "depth"))  # outputs that `draw` suffices for

Source = tuple[Drawable, Camera] | None  # None where splats are drawn by themselves
Named = dict[tuple[str, str], Array]  # by kind ("image" or "feature") and name
Features = Mapping[str, Float[Array, "n _"]]
Color = tuple[float, float, float] | Float[Array, "3"] | Float[np.ndarray, "3"]  # RGB in [0, 1]
BackgroundLike = Color | BackgroundArray | Float[np.ndarray, "h w 3"]  # one colour, or one for each pixel


@pytree
@dataclass(frozen=True)
class Renderer:
    """The settings of `render` as one value, which evaluation, viewers and reports carry.

    It is a pytree, so it passes through `jit`. `Renderer()(scene, camera)` is `render(scene, camera)`.

    Attributes:
        background: RGB seen through what transmittance remains: one colour, one for each pixel, or a function
            of the direction such as `Sky`. Traced.
        low_pass: filter, such as `Antialiasing(0.3)`; None for the one that the scene was trained
            with. Static.
        backend: "auto", the name of a backend, or kernels of your own. Static.
        projection: `Ewa()` or `Unscented()`. Static.
    """

    background: BackgroundLike | Surroundings = (0.0, 0.0, 0.0)
    low_pass: LowPass | None = field(default=None, metadata={"static": True})
    backend: str | Kernels = field(default=backends.AUTO, metadata={"static": True})
    projection: Method = field(default=EWA, metadata={"static": True})

    def __call__(
        self,
        scene: Drawable,
        camera: Camera,
        outputs: Outputs = STANDARD,
        features: Features | None = None,
    ) -> Rendering:
        """Renders a scene; see `render`."""
        check_manner(self.low_pass, self.projection)
        requested = resolve(outputs)
        scene = seen.checked(scene)
        first, *_ = seen.means_of(scene).values()
        kernels = backends.resolve(self.backend, dtype_of(first))
        wanted = [output for _, output in requested]
        if OUTPUTS["rgb"] in wanted and not features and all(output in BLENDED for output in wanted):
            depths = OUTPUTS["depth"] in wanted
            image = pipeline.draw(scene, camera, depths, self.low_pass, kernels, self.projection)
            if image is not None:
                return _named(image, _checked(self.behind(camera), camera, image[1].dtype), requested)
        splats = pipeline.project(scene, camera, self.low_pass, kernels, self.projection)
        return _draw(splats, (scene, camera), self.behind(camera), features or {}, requested, kernels)

    def behind(self, camera: Camera) -> BackgroundLike:
        """Returns the background that a camera sees: one colour, or one for each pixel."""
        if isinstance(self.background, Surroundings):
            return self.background(rays(camera))
        return self.background


def render(
    scene: Drawable,
    camera: Camera,
    *,
    outputs: Outputs = STANDARD,
    features: Features | None = None,
    background: BackgroundLike | Surroundings = BLACK,
    low_pass: LowPass | None = None,
    backend: str | Kernels = backends.AUTO,
    projection: Method = EWA,
) -> Rendering:
    """Renders a scene. Differentiable in all arrays: scene, camera, background and features.

    All outputs and the features have exact derivatives, except that "median_depth" and
    "median_surface_depth" have that of the one Gaussian that they show, and "contributors" has none.

    Args:
        scene: Gaussians, or a `Scene` of parts.
        camera: the view; its width and height are static under `jit`. For several views, use `jax.vmap`.
        outputs: what to render: names from `splatax.outputs.OUTPUTS`, or a mapping from names to outputs of
            your own. Outputs that are not requested are not computed.
        features: further numbers of each Gaussian by name, such as {"labels": [n 24]}. They are blended like
            colour, without a background, and returned under the same names.
        background: RGB seen through what transmittance remains: one colour, one for each pixel, or a function
            of the direction of view, such as `Sky`.
        low_pass: filter, such as `Antialiasing(0.3)`; None for the one that the scene, or each of its parts,
            was trained with.
        backend: "auto", the name of a backend, or kernels of your own.
        projection: how a Gaussian's image is found, `Ewa()` or `Unscented()`; see `splatax.footprints`.

    Raises:
        TypeError: if the scene, the camera, `low_pass` or `projection` is of another kind.
        ValueError: if the shapes or dtypes of the arrays do not fit together, an output is unknown, or the
            backend is unknown or not available here.
    """
    return Renderer(background, low_pass, backend, projection)(scene, camera, outputs, features)


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
        ValueError: as `render`; also for "distance", surface depths and "normals", which splats alone do not
            determine.
    """
    requested = resolve(outputs)
    views.checked(splats)
    kernels = backends.resolve(backend, dtype_of(splats.means2d))
    return _draw(splats, None, background, features or {}, requested, kernels)


def _draw(
    splats: Splats,
    source: Source,
    background: BackgroundLike,
    features: Features,
    requested: tuple[tuple[str, Output], ...],
    kernels: Kernels,
) -> Rendering:
    """Checks background and features, and draws them with the requested outputs."""
    named = {f"features[{name!r}]": (values, "n f") for name, values in features.items()}
    for name, values in named.items():  # each has a width of its own
        check_arrays("Splats", {"means2d": (splats.means2d, "n 2"), name: values})
    behind = _checked(background, splats, splats.means2d.dtype)
    return _finish(splats, source, behind, dict(features), requested, kernels)


def _checked(background: BackgroundLike, image: Camera | Splats, dtype: jnp.dtype) -> BackgroundArray:
    """Returns a background as an array.

    Raises:
        ValueError: if it is neither one colour nor one for each pixel.
    """
    if isinstance(background, str):
        raise ValueError(f"background is the text {background!r}. Give RGB, such as splatax.WHITE.")
    behind = jnp.asarray(background, dtype)
    if behind.shape not in ((3,), (image.height, image.width, 3)):
        raise ValueError(
            f"background has shape {behind.shape}. Give one colour, (3,), or one for each pixel, "
            f"{(image.height, image.width, 3)}."
        )
    return behind


@partial(jax.jit, static_argnames="requested")
def _named(
    image: tuple[Float[Array, "h w c"], Float[Array, "h w"]],
    background: BackgroundArray,
    requested: tuple[tuple[str, Output], ...],
) -> Rendering:
    """Returns requested outputs of `BLENDED`, from the sums of colours and depths, and alpha."""
    (sums, alpha), background = vary_together(image, background)

    def drawn(output: Output) -> Drawn:
        own = sums[..., 3:] if output == OUTPUTS["depth"] else sums[..., :3]
        return Drawn(own, alpha, None, None, background)

    return Rendering({name: output.finish(drawn(output)) for name, output in requested}, {})


@partial(jax.jit, static_argnames=("requested", "kernels"))
def _finish(
    splats: Splats,
    source: Source,
    background: BackgroundArray,
    features: Features,
    requested: tuple[tuple[str, Output], ...],
    kernels: Kernels,
) -> Rendering:
    splats, source, background, features = vary_together(splats, source, background, features)
    view = Seen(splats, None, None)
    if source is not None:  # the compiler removes what no output uses of the Gaussians in the world
        view = Seen(splats, seen.in_world(source[0]), source[1], seen.sizes_of(source[0]), kernels)
    painted = unrolled(view)
    if painted is not view:
        features = jax.tree.map(lambda rows: jnp.concatenate([rows, rows]), features)
    channels = {("image", name): output.channels(painted) for name, output in requested if output.channels}
    channels |= {("feature", name): values for name, values in features.items()}
    counts = [output.selected for _, output in requested if output.selected is not None]
    parts = next((("image", name) for name, output in requested if output == OUTPUTS["parts"]), None)
    sums, alpha, selection = _blended(painted, view, channels, parts, counts, kernels)

    def drawn(name: str, output: Output) -> Drawn:
        count = output.selected
        own = None
        if selection is not None and count is not None:
            own = Selection(selection.indices[..., :count], selection.weights[..., :count], selection.median)
        return Drawn(sums.get(("image", name)), alpha, own, view, background)

    return Rendering(
        images={name: output.finish(drawn(name, output)) for name, output in requested},
        features={name: sums["feature", name] for name in features},
    )


def _blended(
    painted: Seen,
    view: Seen,
    channels: Named,
    parts: tuple[str, str] | None,
    counts: Sequence[int],
    kernels: Kernels,
) -> tuple[Named, Array | None, Selection | None]:
    """Blends channels and selects splats, in one walk where the backend has a kernel for it.

    Args:
        painted: the view with copies of the splats beside its seam.
        view: the view.
        channels: what to blend, by name.
        parts: the name of the channels of the scene's parts; None if they are not among the channels.
        counts: for each output that needs them, how many splats to select; 0 for the median only.
        kernels: the backend.

    Returns:
        The sums by name, and alpha; the selected splats. They are None if nothing asks for them.
    """
    if parts is not None:
        channels = {name: rows for name, rows in channels.items() if name != parts} | {parts: channels[parts]}
    widths = np.cumsum([values.shape[1] for values in channels.values()])
    stacked = jnp.concatenate(list(channels.values()), axis=1) if channels else None
    sizes = painted.sizes if parts is not None and painted.sizes is not None else ()
    together = painted is view and (sizes or counts) and max(counts, default=0) == 0
    if stacked is not None and together and len(view.splats.depths):
        splats = views.for_kernels(view.splats)
        survey = kernels.in_one_walk(splats, stacked.shape[1] - len(sizes), len(sizes))
        if survey is not None:
            blended, alpha, median = survey(splats, stacked, sizes)
            none = jnp.zeros((*median.shape, 0))
            found = Selection(none.astype(jnp.int32), none.astype(blended.dtype), median)
            return dict(zip(channels, jnp.split(blended, widths[:-1], axis=2), strict=True)), alpha, found
    selection = pipeline.select(view.splats, max(counts), kernels) if counts else None
    if stacked is None:
        return {}, None, selection
    blended, alpha = pipeline.composite(painted.splats, stacked, kernels)
    return dict(zip(channels, jnp.split(blended, widths[:-1], axis=2), strict=True)), alpha, selection
