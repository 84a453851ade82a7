"""Label cameras: which part, or which kind of thing, each pixel shows."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.outputs import Rendering
from splatax.pytrees import pytree
from splatax.scene import Drawable
from splatax.sensors.protocol import Key, Plain


@pytree
@dataclass(frozen=True)
class Labels(Plain):
    """A camera of labels. Its measurement is an image [h w] of whole numbers, -1 where nothing wins.

    A pixel has the label of the Gaussians that fill most of it, if that is more than what shows through.
    Without `rows`, labels are the numbers of the parts of a `Scene`, in the order of `Scene.names`.

    Attributes:
        rows: label of each Gaussian, from 0; -1 for none. None for the parts of a scene.
        count: number of labels (static); needed with `rows`.
    """

    rows: Int[Array, " n"] | None = None
    count: int = field(default=0, metadata={"static": True})

    def __post_init__(self) -> None:
        if self.rows is not None and self.count < 1:
            raise ValueError(
                f"labels of Gaussians need the number of labels, and count is {self.count}. Give it, for "
                "example 1 + the largest label."
            )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        return ("alpha", "parts") if self.rows is None else ("alpha",)

    def features(self, scene: Drawable) -> dict[str, Array]:
        """Returns 1 for each Gaussian in the column of its label; nothing where parts are labels.

        Raises:
            ValueError: if the labels are not as many as the Gaussians, a known one is not below `count`, or
                there are neither labels nor parts.
        """
        if self.rows is None:
            if isinstance(scene, Gaussians):
                raise ValueError(
                    "Gaussians alone have no parts to label. Give each a label (Labels(rows, count)), or "
                    "make a Scene of parts."
                )
            return {}
        if self.rows.shape != (len(scene),):
            raise ValueError(f"labels of shape {self.rows.shape} for a scene of {len(scene):,} Gaussians.")
        # With NumPy: inside `jit`, JAX traces operations on known arrays too.
        if not isinstance(self.rows, jax.core.Tracer):
            largest = int(np.max(np.asarray(self.rows), initial=-1))
            if largest >= self.count:
                raise ValueError(
                    f"Gaussians have labels up to {largest}, and count is {self.count}. Give 1 + the largest "
                    "label."
                )
        first = scene if isinstance(scene, Gaussians) else next(iter(scene.parts.values())).gaussians
        return {"labels": jax.nn.one_hot(self.rows, self.count, dtype=first.means.dtype)}

    def read(
        self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None
    ) -> Int[Array, "h w"]:
        """Returns the label of each pixel."""
        (image,) = drawn
        filled = image.parts if self.rows is None else image.features["labels"]
        best = jnp.argmax(filled, axis=-1).astype(jnp.int32)
        return jnp.where(jnp.max(filled, axis=-1) > 1 - image.alpha, best, -1)
