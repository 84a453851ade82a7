"""The inputs of outputs: one view before and after its splats are blended."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax import splats as views
from splatax.backends.protocol import Kernels, Selection
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.surfaces import Planes

BackgroundArray = Float[Array, "3"] | Float[Array, "h w 3"]


class Seen(NamedTuple):
    """Input of `Output.channels`: one view's splats, and the scene and camera that they come from.

    Scene, camera and sizes are None where splats are drawn by themselves.

    Attributes:
        splats: the 2D Gaussians of the view.
        gaussians: the scene in world coordinates, also if it has parts; one row for each splat, in order.
        camera: the view.
        sizes: the number of Gaussians of each part. A scene without parts is one.
        kernels: the backend that finds planes; None where splats are drawn by themselves.
    """

    splats: Splats
    gaussians: Gaussians | None
    camera: Camera | None
    sizes: tuple[int, ...] | None = None
    kernels: Kernels | None = None


class Drawn(NamedTuple):
    """Input of `Output.finish`. Fields that the output did not ask for are None."""

    sums: Float[Array, "h w c"] | None  # of weight times channel
    alpha: Float[Array, "h w"] | None
    selection: Selection | None
    seen: Seen | None  # None if the image was drawn without splats
    background: BackgroundArray

    @property
    def splats(self) -> Splats:
        """The splats of the view."""
        assert self.seen is not None
        return self.seen.splats


def unrolled(seen: Seen) -> Seen:
    """Returns the splats that are painted, with their Gaussians: a panorama has copies beside its seam."""
    if seen.splats.period is None:
        return seen
    splats, _ = views.unrolled(seen.splats, seen.splats.colors)
    return seen._replace(
        splats=splats, gaussians=jax.tree.map(lambda rows: jnp.concatenate([rows, rows]), seen.gaussians)
    )


def scene_of(seen: Seen | None, output: str) -> tuple[Gaussians, Camera]:
    """Returns the scene and the camera of a view.

    Raises:
        ValueError: naming the output, if there are only splats.
    """
    if seen is None or seen.gaussians is None or seen.camera is None:
        raise ValueError(
            f"output {output!r} needs the scene and its camera: use render instead of rasterize."
        )
    return seen.gaussians, seen.camera


def planes_of(seen: Seen | None, output: str) -> Planes:
    """Returns the plane of each Gaussian of a view.

    Raises:
        ValueError: naming the output, if there are only splats.
    """
    gaussians, camera = scene_of(seen, output)
    assert seen is not None
    assert seen.kernels is not None
    return seen.kernels.planes(gaussians, camera, seen.splats)


def selection_of(drawn: Drawn) -> Selection:
    """Returns the splats that decide each pixel of a view, which the output has asked for."""
    assert drawn.selection is not None
    return drawn.selection
