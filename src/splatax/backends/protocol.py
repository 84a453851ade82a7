"""The protocol of a backend: a complete set of kernels, one for each stage of the pipeline."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float, Int

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.splats import Splats


@runtime_checkable
class Project(Protocol):
    """The left half of the pipeline, from Gaussians to the 2D Gaussians of one view."""

    def __call__(self, gaussians: Gaussians, camera: Camera, low_pass: LowPass) -> Splats:
        """Projects as `splatax.projection.project` does, with the same rules for what is culled."""
        ...


@runtime_checkable
class Composite(Protocol):
    """The right half of the pipeline, from the 2D Gaussians of one view to an image."""

    def __call__(
        self, splats: Splats, channels: Float[Array, "n c"]
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
        """Blends channels as `splatax.backends.reference.composite` does. There is at least one splat."""
        ...


MOST_SELECTED = 64  # splats at a pixel that `select` finds; as in native/cpu/select.h


class Selection(NamedTuple):
    """The splats that decide each pixel, as rows of `Splats`; -1 where there is none.

    Attributes:
        indices: those with the largest weights, largest first, and nearest first among equal weights.
        weights: their weights; 0 where there is none.
        median: the first splat, from near to far, after which transmittance is at most one half.
    """

    indices: Int[Array, "h w k"]
    weights: Float[Array, "h w k"]
    median: Int[Array, "h w"]


@runtime_checkable
class Select(Protocol):
    """The right half of the pipeline as indices: the 2D Gaussians that decide each pixel."""

    def __call__(self, splats: Splats, count: int) -> Selection:
        """Selects as `splatax.backends.reference.select` does.

        There is at least one splat, `count` is from 0 to `MOST_SELECTED`, and no gradient is asked for.
        """
        ...


@runtime_checkable
class Photometric(Protocol):
    """The loss between an image and a photo."""

    def __call__(
        self, image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float
    ) -> Float[Array, ""]:
        """Computes what `splatax.losses.photometric` does."""
        ...


def runs_everywhere() -> str | None:
    """Returns None: the kernels run wherever JAX does."""
    return None


@dataclass(frozen=True)
class Kernels:
    """A backend. It is always complete; one that lacks a kernel takes that of the portable backend by name.

    It is hashable, so it can be a static argument of `jit`. To try a kernel of your own, replace one:
    `replace(backends.resolve("xla"), name="mine", composite=my_composite)`, and pass the result as `backend`.

    Attributes:
        name: identifies the backend in messages and in the results of runs.
        project: the projection.
        composite: the rasterizer.
        select: the splats that decide each pixel.
        photometric: the loss.
        why_unavailable: returns the reason why the kernels cannot run on this machine, or None if they can.
        dtypes: the names of the dtypes that all of the kernels compute in.
    """

    name: str
    project: Project
    composite: Composite
    select: Select
    photometric: Photometric
    why_unavailable: Callable[[], str | None] = runs_everywhere
    dtypes: tuple[str, ...] = ("float32", "float64")
