"""The parts of a recipe: what each of them must do, and the records that they exchange with the trainer.

A part is any object that has these methods; it inherits from nothing here. It must be hashable and
compare by value, because the recipe is static under `jit`: a frozen dataclass of settings is both. What
a part learns or counts during a run is kept in a state, a pytree of arrays that the trainer passes in
and takes back.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from splatax.cameras import Camera
from splatax.dataset import Dataset
from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training.objectives import Geometry as Geometry
from splatax.training.objectives import Loss as Loss
from splatax.training.objectives import PhotoWeights as PhotoWeights
from splatax.training.objectives import Prior as Prior
from splatax.training.objectives import TrainingView as TrainingView

HostOrDevice = (
    np.ndarray | Array
)  # rows that a strategy plans with on the host, and makes others of on devices


class Source(NamedTuple):
    """The training photo that a batch shows."""

    view: Int[Array, ""] | np.int32  # index of the photo, from 0; of all faces of a 360-degree photo
    lens: Int[Array, ""] | np.int32  # index of the lens that took it, from 0
    pixel: Float[Array, ""] | np.float32 = np.float32(1e-3)  # angle of a pixel of the full photo, radians
    place: Float[Array, "3"] | Float[np.ndarray, "3"] = np.zeros(3, np.float32)  # optical centre as given


@dataclass(frozen=True)
class DensityPlan:
    """A plan of a refined scene: one entry for each Gaussian that it will have. On the host.

    Attributes:
        parents: row of the old scene that each row is made from.
        newborn: rows whose optimizer state starts anew instead of following that of the parent.
        given: what `DensityStrategy.reborn` needs for each row; a pytree of arrays.
        restarted: names of the fields whose optimizer state starts anew in every row.
        observes_anew: whether the state of the strategy starts anew; if not, it follows the parents.
        most: number of Gaussians that the scene will never exceed, if that is known.
    """

    parents: Int[np.ndarray, " n"]
    newborn: Bool[np.ndarray, " n"]
    given: Any = ()
    restarted: tuple[str, ...] = ()
    observes_anew: bool = True
    most: int | None = None

    @property
    def count(self) -> int:
        """The number of Gaussians."""
        return len(self.parents)


@runtime_checkable
class Initialization(Hashable, Protocol):
    """Creates the Gaussians from which training starts."""

    def number(self, dataset: Dataset) -> int:
        """Returns about how many Gaussians there will be, without creating them."""
        ...

    def __call__(self, dataset: Dataset, sh_degree: int, seed: int) -> Gaussians:
        """Returns the first Gaussians of a run.

        Raises:
            DatasetError: if the capture lacks what they are made from.
        """
        ...


@runtime_checkable
class UpdateRule(Hashable, Protocol):
    """Builds the transformation of optax that turns gradients into updates, such as `Adam`.

    It is a value that builds the transformation, because transformations themselves cannot be compared.
    """

    def __call__(self) -> optax.GradientTransformation:
        """Returns a transformation whose updates are for a learning rate of 1 and are added to the scene.

        Its state may hold copies of the scene's shape, such as moments, and numbers that all rows share, such
        as a step count. The copies follow the Gaussians through density control. A step on several views
        updates blocks of rows one after the other, so a rule must treat each row independently. The opacity
        logits of empty slots are minus infinity; updates of them are ignored.
        """
        ...


@runtime_checkable
class Noise(Hashable, Protocol):
    """Adds noise to the scene after each step."""

    def __call__(
        self, gaussians: Gaussians, rate: Float[Array, " m"], extent: Float[Array, ""], key: PRNGKeyArray
    ) -> Gaussians:
        """Returns the scene with noise added. Runs under `jit`.

        Args:
            gaussians: the scene.
            rate: learning rate of the means, world units per step: one, or one for each Gaussian; 0 if the
                step is discarded.
            extent: of the scene, world units.
            key: of this step.
        """
        ...


@runtime_checkable
class Reach(Hashable, Protocol):
    """Chooses the length that the learning rate of the means is a fraction of."""

    def __call__(self, depths: Float[Array, " n"], extent: Float[Array, ""]) -> Float[Array, " m"]:
        """Returns one length, or one for each Gaussian, world units. Runs under `jit`.

        Args:
            depths: of the Gaussians in the step's view, world units of camera z.
            extent: of the scene, world units.
        """
        ...


@runtime_checkable
class DensityStrategy(Hashable, Protocol):
    """Adds, moves and removes Gaussians during training."""

    def init(self, capacity: int) -> Any:
        """Returns the state before the first step, for this many rows."""
        ...

    def watch(self, splats: Splats) -> Splats:
        """Returns the splats of a view, with `pull` added if `observe` reads its gradient."""
        ...

    def observe(self, state: Any, splats: Splats, d_splats: Splats) -> Any:
        """Returns the state after one view. Runs under `jit`.

        Args:
            state: before the view.
            splats: the 2D Gaussians of the view.
            d_splats: gradient of the loss with respect to them.
        """
        ...

    def due(self, step: int) -> bool:
        """Returns whether the scene is refined after this many steps."""
        ...

    def columns(self, state: Any, gaussians: Gaussians) -> Any:
        """Returns the arrays that `plan` reads, each with a row for every Gaussian, without changing them.

        They are copied to the host of every process, unlike the rest of the scene: choose few.
        """
        ...

    def plan(self, columns: Any, step: int, extent: float, key: PRNGKeyArray) -> DensityPlan:
        """Returns which Gaussians the refined scene has. The same arguments give the same plan.

        Args:
            columns: those of the living Gaussians, on the host.
            step: number of steps made.
            extent: of the scene, world units.
            key: for random choices.
        """
        ...

    def reborn(self, gaussians: Gaussians, state: Any, given: Any) -> Gaussians:
        """Returns rows of the refined scene. Runs under `jit`, on any number of rows, each independently.

        Args:
            gaussians: the parent of each row.
            state: of the strategy, for the parents.
            given: of the plan, for the rows. Empty slots have zeros here; the result for them is not used.
        """
        ...


class PerPhotoPart(Hashable, Protocol):
    """Learns parameters of each training photo."""

    def init(self, photos: int) -> Any:
        """Returns the state before the first step, for this many training photos."""
        ...

    def for_photo(self, state: Any, source: Source) -> Any:
        """Returns the parameters of one photo, a pytree that gradients are taken for."""
        ...

    def update(
        self, state: Any, source: Source, gradient: Any, progress: Float[Array, ""], steps: Float[Array, ""]
    ) -> Any:
        """Returns the state after a step on one photo. Runs under `jit`.

        Args:
            state: before the step.
            source: the photo.
            gradient: of the loss, in the shape of the photo's parameters.
            progress: fraction of the run that is done, 0 to 1.
            steps: number of steps of the whole run.
        """
        ...


@runtime_checkable
class Appearance(PerPhotoPart, Protocol):
    """Models how the colours of a photo differ from those of the scene."""

    def __call__(
        self, parameters: Any, sums: Float[Array, "h w 3"], alpha: Float[Array, "h w"]
    ) -> Float[Array, "h w 3"]:
        """Returns the rendering in the colours of a photo. Differentiable, runs under `jit`.

        Args:
            parameters: of the photo.
            sums: rendered colours, weighted by alpha, without a background.
            alpha: coverage of each pixel, in [0, 1].
        """
        ...


@runtime_checkable
class CameraRefinement(PerPhotoPart, Protocol):
    """Corrects the cameras of the training photos."""

    def __call__(self, parameters: Any, camera: Camera, extent: Float[Array, ""]) -> Camera:
        """Returns the corrected camera of a photo. Differentiable, runs under `jit`.

        Args:
            parameters: of the photo.
            camera: as it was given.
            extent: of the scene, world units.
        """
        ...


@runtime_checkable
class Background(Hashable, Protocol):
    """Chooses the colour behind the scene."""

    @property
    def rgb(self) -> tuple[float, float, float]:
        """The colour that evaluation and pictures use, RGB in [0, 1]."""
        ...

    def sample(self, key: PRNGKeyArray) -> Float[Array, "3"]:
        """Returns the colour for one training step, RGB in [0, 1]. Runs under `jit`."""
        ...


@runtime_checkable
class ResolutionSchedule(Hashable, Protocol):
    """Chooses the size of the photos during training."""

    @property
    def divisors(self) -> tuple[int, ...]:
        """All factors that `divisor` may return."""
        ...

    def divisor(self, step: int, size: tuple[int, int]) -> int:
        """Returns the factor by which photos of this size are downscaled at this step, counted from 1.

        1 is full size.
        """
        ...
