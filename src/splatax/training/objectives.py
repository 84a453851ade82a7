"""The parts of an objective: what a loss, a prior and a regularizer of geometry must do.

`splatax.training.protocols` has them too, with the parts of a recipe.
"""

from collections.abc import Hashable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatax.backends.protocol import Photometric
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.outputs import Output


@runtime_checkable
class Loss(Hashable, Protocol):
    """Compares a rendering with a photo."""

    def __call__(
        self,
        image: Float[Array, "h w 3"],
        photo: Float[Array, "h w 3"],
        mask: Bool[Array, "h w"] | None,
        kernel: Photometric,
    ) -> Float[Array, ""]:
        """Returns the loss, differentiable in `image`. Runs under `jit`.

        Args:
            image: the rendering, values around [0, 1].
            photo: values in [0, 1].
            mask: true where a pixel counts; None if all do.
            kernel: the backend's implementation of `splatax.losses.photometric`, for losses that use it.
        """
        ...


@runtime_checkable
class Prior(Hashable, Protocol):
    """Adds a penalty on the Gaussians to the loss."""

    def __call__(
        self, gaussians: Gaussians, extent: Float[Array, ""], living: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Returns the penalty, differentiable in the scene. Runs under `jit`.

        It is a sum over Gaussians, so that it can be computed for one part of the scene after the other.

        Args:
            gaussians: the scene or a part of it; empty slots must get no gradient.
            extent: of the scene, world units.
            living: number of living Gaussians of the whole scene, for means over them.
        """
        ...


class TrainingView(NamedTuple):
    """A training view, as regularizers of geometry know it.

    Attributes:
        camera: of the view, as corrected.
        landmarks: world points that the photo shows, with rows of NaN that stand for none; None if the
            capture knows of none.
        progress: fraction of the run that is done, 0 to 1.
    """

    camera: Camera
    landmarks: Float[Array, "k 3"] | None
    progress: Float[Array, ""]


@runtime_checkable
class PhotoWeights(Hashable, Protocol):
    """Weighs the training photos in the loss."""

    def init(self, photos: int) -> Any:
        """Returns the state before the first step, for this many training photos."""
        ...

    def of_photos(self, state: Any, photos: int, progress: Float[Array, ""]) -> Float[Array, " photos"]:
        """Returns the weights of all training photos.

        Args:
            state: after the last step.
            photos: their number.
            progress: fraction of the run that is done, 0 to 1.
        """
        ...

    def of_photo(self, state: Any, photo: Int[Array, ""] | np.int32, progress: Float[Array, ""]) -> Any:
        """Returns the weight of one photo, given its index: a scalar, or 1.0. Runs under `jit`."""
        ...

    def update(self, state: Any, photo: Int[Array, ""] | np.int32, loss: Float[Array, ""]) -> Any:
        """Returns the state after a step on one photo. Runs under `jit`.

        Args:
            state: before the step.
            photo: index of the photo.
            loss: of the photo, not weighted.
        """
        ...


@runtime_checkable
class Geometry(Hashable, Protocol):
    """Adds a penalty on what a training view shows of the scene's geometry to the loss."""

    @property
    def outputs(self) -> Mapping[str, Output]:
        """The outputs to draw beside the colours, by name; only those of blended channels.

        It must have equal values for equal settings.
        """
        ...

    @property
    def after(self) -> float:
        """The fraction of the run before which the penalty is zero. No output is drawn until then."""
        ...

    def __call__(self, images: Mapping[str, Any], seen: TrainingView) -> Float[Array, ""]:
        """Returns the penalty, differentiable in the images. Runs under `jit`, and only if there are some.

        Args:
            images: the outputs by name. Photos of many sizes are drawn on canvases: what lies beyond
                `Camera.frame` is not defined and must not count; see
                `splatax.training.canvases.mean_over`.
            seen: the view that they show.
        """
        ...
