"""Motion of a camera during the exposure: rolling shutters, which expose one row after another."""

from dataclasses import dataclass, field
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.pytrees import pytree

Direction = Literal["down", "up", "right", "left"]


@pytree
@dataclass(frozen=True)
class RollingShutter:
    """A camera that moves evenly while its rows, or columns, are exposed one after another.

    `Camera.cam_from_world` is the pose at the middle of the exposure. At time t, from -1/2 for the first row
    to 1/2 for the last, it is exp(t twist) cam_from_world. Points beside the image are seen at the time of
    the nearest row.

    Attributes:
        twist: motion over the whole exposure in camera axes, rotation (radians) before translation (world
            units); see `math.rigid.exponential`.
        direction: in which the exposure goes over the image (static).
    """

    twist: Float[Array, "6"]
    direction: Direction = field(default="down", metadata={"static": True})

    def time(
        self, pixel: Float[Array, "2"], width: int | Float[Array, ""], height: int | Float[Array, ""]
    ) -> Float[Array, ""]:
        """Returns when a pixel is exposed, from -1/2 to 1/2."""
        fraction = pixel[0] / width if self.direction in ("right", "left") else pixel[1] / height
        t = jnp.clip(fraction, 0, 1) - 0.5
        return -t if self.direction in ("up", "left") else t
