"""Models of the differences in exposure and white balance between photos."""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.training import per_photo
from splatax.training.per_photo import NoParameters, PerPhoto, PerView
from splatax.training.protocols import Appearance, Source


@dataclass(frozen=True)
class NoAppearance(NoParameters):
    """Assumes that all photos show the colours of the scene."""

    def __call__(
        self, parameters: tuple[()], sums: Float[Array, "h w 3"], alpha: Float[Array, "h w"]
    ) -> Float[Array, "h w 3"]:
        """Returns the rendering unchanged."""
        return sums


@dataclass(frozen=True)
class Exposure(PerView):
    """Learns an affine map of colours for each photo, c' = (I + D) c + d.

    The map applies to the scene and not to the background behind it. The mean of the maps over the
    photos is held at the identity, so that the scene has the colours of a mean photo. The learning rates
    are those of the authors' code of Kerbl et al. 2023.
    """

    WIDTH: ClassVar[int] = 12  # [D | d], row by row
    rate: float = 0.01  # learning rate at the start
    rate_final: float = 0.001  # learning rate at the end; log-linear between

    @jax.default_matmul_precision("highest")
    def __call__(
        self, parameters: Float[Array, "12"], sums: Float[Array, "h w 3"], alpha: Float[Array, "h w"]
    ) -> Float[Array, "h w 3"]:
        """Applies the map of a photo to the rendering, which is weighted by alpha."""
        change = parameters.reshape(3, 4)
        return (
            sums
            + jnp.einsum("hwc,kc->hwk", sums, change[:, :3])
            + alpha[..., None] * change[None, None, :, 3]
        )

    def update(
        self,
        state: PerPhoto,
        source: Source,
        gradient: Float[Array, "12"],
        progress: Float[Array, ""],
        steps: Float[Array, ""],
    ) -> PerPhoto:
        """Makes one step for one photo, then restores the mean map to the identity."""
        rate = per_photo.log_linear(self.rate, self.rate_final, progress)
        state = per_photo.updated(state, source.view, gradient, rate)
        return replace(state, values=per_photo.centred(state.values))


APPEARANCES: dict[str, Appearance] = {"none": NoAppearance(), "exposure": Exposure()}
