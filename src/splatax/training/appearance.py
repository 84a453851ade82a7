"""How each photo shows the colours of the scene: exposure and white balance that the camera chose for it."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.training import per_photo
from splatax.training.feed import Source
from splatax.training.per_photo import NoParameters, PerPhoto


@dataclass(frozen=True)
class NoAppearance(NoParameters):
    """All photos show the colours of the scene as they are."""

    def __call__(self, known: tuple[()], sums: Float[Array, "h w 3"], alpha: Float[Array, "h w"]):
        """The rendering as the photo would show it: as it is."""
        return sums


@dataclass(frozen=True)
class Exposure:
    """An affine map of colour for each photo, c' = (I + D) c + d.

    It maps the scene alone, and not the background behind it. The maps have the identity as their mean
    over photos, so that the scene has the colours of a mean photo, and not some that only the maps
    would make right. The rates are those of the authors' code of Kerbl et al. 2023.
    """

    rate: float = 0.01  # of Adam, at the start
    rate_final: float = 0.001  # at the end; log-linear between

    def init(self, photos: int) -> PerPhoto:
        """Identities: a row has D and d, [D | d] row by row."""
        return per_photo.zeros(photos, 12)

    def of(self, state: PerPhoto, source: Source) -> Float[Array, "12"]:
        """The row of a photo."""
        return state.values[source.view]

    @jax.default_matmul_precision("highest")
    def __call__(
        self, known: Float[Array, "12"], sums: Float[Array, "h w 3"], alpha: Float[Array, "h w"]
    ) -> Float[Array, "h w 3"]:
        """The rendering, weighted by alpha, as the photo would show it."""
        change = known.reshape(3, 4)
        return (
            sums
            + jnp.einsum("hwc,kc->hwk", sums, change[:, :3])
            + alpha[..., None] * change[None, None, :, 3]
        )

    def update(
        self, state: PerPhoto, source: Source, gradient: Float[Array, "12"], progress: Float[Array, ""]
    ) -> PerPhoto:
        """The state after a step."""
        rate = per_photo.falling(self.rate, self.rate_final, progress)
        state = per_photo.moved(state, source.view, gradient, rate)
        return replace(state, values=per_photo.centred(state.values))


Appearance = NoAppearance | Exposure
APPEARANCES: dict[str, Appearance] = {"none": NoAppearance(), "exposure": Exposure()}
