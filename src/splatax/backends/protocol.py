"""The protocol of a backend: a complete set of kernels, one for each stage of the pipeline."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float, Int

from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.moving import Moments, Rule, Step
from splatax.splats import Splats
from splatax.surfaces import Planes


@runtime_checkable
class Project(Protocol):
    """The left half of the pipeline, from Gaussians to the 2D Gaussians of one view."""

    def __call__(
        self, gaussians: Gaussians, camera: Camera, low_pass: LowPass, method: Method = EWA
    ) -> Splats:
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


@runtime_checkable
class Draw(Protocol):
    """Both halves of the pipeline at once, for colour and depth: faster for a batch of views of one scene.

    It stands for a projection and a rasterizer, and draws what they draw.
    """

    @property
    def project(self) -> Project:
        """The projection that it stands for."""
        ...

    @property
    def composite(self) -> Composite:
        """The rasterizer that it stands for."""
        ...

    def fits(self, camera: Camera, method: Method) -> bool:
        """Returns whether it draws what such a camera sees."""
        ...

    def __call__(
        self, gaussians: Gaussians, camera: Camera, low_pass: LowPass, depths: bool
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
        """Returns the sums of weight times colour, and times depth if asked for, and alpha.

        There is at least one Gaussian, and the camera fits.
        """
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
class Survey(Protocol):
    """`Composite` and `Select` at once, for a few channels and the parts of a scene: faster than both.

    It stands for a rasterizer and a selection, and returns what they return.
    """

    @property
    def composite(self) -> Composite:
        """The rasterizer that it stands for."""
        ...

    @property
    def select(self) -> Select:
        """The selection that it stands for."""
        ...

    def fits(self, splats: Splats, channels: int, parts: int) -> bool:
        """Returns whether it draws so many channels and parts of such splats."""
        ...

    def __call__(
        self, splats: Splats, channels: Float[Array, "n c"], sizes: tuple[int, ...]
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"], Int[Array, "h w"]]:
        """Returns the sums of channels, alpha, and the median of `Selection`.

        Args:
            splats: at least one.
            channels: as for `Composite`. The last ones, as many as there are sizes, are 1 for the splats of
                one part each, and 0 for the others.
            sizes: the number of splats in each part, in order; none if the parts are not asked for.
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


@runtime_checkable
class Move(Protocol):
    """A training step of the rows of a scene, from the gradient of the loss to the moved Gaussians."""

    def __call__(
        self, gaussians: Gaussians, gradients: Gaussians, moments: Moments, step: Step, rule: Rule, block: int
    ) -> tuple[Gaussians, Moments]:
        """Moves as `splatax.moving.move` does."""
        ...


class PulledView(NamedTuple):
    """The splats of one view of a scene, and the gradient of a loss with respect to them."""

    camera: Camera
    low_pass: LowPass  # that the scene was projected with, by EWA
    splats: Splats
    d_splats: Splats


@runtime_checkable
class PullAndMove(Protocol):
    """The gradient of a projection and a training step with it: faster, because the gradient is never stored.

    It stands for a projection and a move, and moves as they do.
    """

    @property
    def project(self) -> Project:
        """The projection that it stands for."""
        ...

    @property
    def move(self) -> Move:
        """The move that it stands for."""
        ...

    def fits(self, camera: Camera, low_pass: LowPass) -> bool:
        """Returns whether it finds the gradient of such a view."""
        ...

    def __call__(
        self, gaussians: Gaussians, view: PulledView, moments: Moments, step: Step, rule: Rule, block: int
    ) -> tuple[Gaussians, Moments, Camera]:
        """Moves by the gradient of a view; returns the gradient of its camera too."""
        ...


@runtime_checkable
class FindPlanes(Protocol):
    """The plane of each Gaussian in one view, from which depths and normals of surfaces are blended."""

    def __call__(self, gaussians: Gaussians, camera: Camera, splats: Splats) -> Planes:
        """Finds planes as `splatax.surfaces.planes` does."""
        ...


def runs_everywhere() -> str | None:
    """Returns None: the kernels run wherever JAX does."""
    return None


@dataclass(frozen=True)
class Kernels:
    """A backend: a complete set of kernels. One that lacks a kernel has that of the portable backend.

    It is hashable, so it can be a static argument of `jit`. To try a kernel of your own, replace one:
    `replace(backends.resolve("xla"), name="mine", composite=my_composite)`, and pass the result as `backend`.

    Attributes:
        name: identifies the backend in messages and in the results of runs.
        project: the projection. Gaussians that are drawn along rays (`low_pass.AlongRays`) are projected by
            `splatax.along_rays` on every backend, not by this kernel.
        composite: the rasterizer.
        select: the splats that decide each pixel.
        photometric: the loss.
        move: a step of Adam with the rows of the scene, with its prior and noise. Training uses it for the
            optimizers of the presets; others go through optax.
        planes: the planes of Gaussians.
        why_unavailable: returns the reason why the kernels cannot run on this machine, or None if they can.
        dtypes: the names of the dtypes that all of the kernels compute in.
        draw: projection and rasterizer in one kernel; None if the backend has only the two. It is not used
            if you replace `project` or `composite` by kernels of your own.
        survey: `composite` and `select` in one kernel; None if the backend has only the two. It is not used
            if you replace one of them.
        pull_and_move: the gradient of `project` and `move` in one kernel; None if the backend has only the
            two. It is not used if you replace one of them.
    """

    name: str
    project: Project
    composite: Composite
    select: Select
    photometric: Photometric
    move: Move
    planes: FindPlanes
    why_unavailable: Callable[[], str | None] = runs_everywhere
    dtypes: tuple[str, ...] = ("float32", "float64")
    draw: Draw | None = None
    survey: Survey | None = None
    pull_and_move: PullAndMove | None = None

    def at_once(self, camera: Camera, method: Method) -> Draw | None:
        """Returns the kernel that draws what a camera sees at once; None if two kernels must do it."""
        draw = self.draw
        if draw is None or (draw.project, draw.composite) != (self.project, self.composite):
            return None
        return draw if draw.fits(camera, method) else None

    def in_one_walk(self, splats: Splats, channels: int, parts: int) -> Survey | None:
        """Returns the kernel that blends and selects at once; None if two kernels must do it.

        Args:
            splats: of the view.
            channels: number of channels beside those of the parts.
            parts: number of parts whose sums are asked for.
        """
        survey = self.survey
        if survey is None or (survey.composite, survey.select) != (self.composite, self.select):
            return None
        return survey if survey.fits(splats, channels, parts) else None

    def moved_at_once(self, camera: Camera, low_pass: LowPass) -> PullAndMove | None:
        """Returns the kernel that moves by the gradient of a view; None if two kernels must do it."""
        both = self.pull_and_move
        if both is None or (both.project, both.move) != (self.project, self.move):
            return None
        return both if both.fits(camera, low_pass) else None
